"""Every registered model, by role: any order, number and size of images, and gradients that stay finite."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from sdps_samples import distant_layout
from sdps_scenes import hemisphere_lights, shade, sphere_normals

from render.shared.config import to_plain
from sdps.core.estimate import Estimate
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch
from sdps.inference.estimator import Estimator
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import MODELS, TRUE_LIGHTS, create
from sdps.training.stage_factory import create_stage
from sdps.training.stages import Stage
from sdps.training.training_config import LightingTraining, NormalTraining, PixelTraining

LIGHTING = [name for name, entry in MODELS.items() if entry.role == "lighting"]
NORMALS = [name for name, entry in MODELS.items() if entry.role in ("normals", "pixels")]


def trained(name: str) -> TrainedModel:
    """Return a model with random weights."""
    torch.manual_seed(0)
    return TrainedModel(name, create(name).eval(), {}, {"config": {"augmentation": to_plain(Augmentation())}})


@pytest.fixture(scope="module")
def models() -> dict[str, TrainedModel]:
    return {name: trained(name) for name in MODELS}


def combination(models: dict[str, TrainedModel], name: str, **options: Any) -> Estimator:
    """Return an estimator in which model `name` works, with the others it needs."""
    role = MODELS[name].role
    places = {"lighting": "lcnet", "normals": "nenet"}
    if role == "normals" and not MODELS[name].lights:
        places["lighting"] = ""
    places["normals" if role == "pixels" else role] = name
    chosen = {place: models[model] if model else None for place, model in places.items()}
    # Classes would hide small differences, or turn them into large ones at a tie.
    return Estimator(
        **chosen, device=torch.device("cpu"), precision="float32", read_out="expectation", rotations=2, **options
    )


class Scene(NamedTuple):
    """Arguments of `Estimator.estimate`."""

    images: np.ndarray
    mask: np.ndarray
    lights: np.ndarray | None
    intensities: np.ndarray | None

    def of(self, images: np.ndarray) -> "Scene":
        return self._replace(images=images)

    def reordered(self, order: np.ndarray) -> "Scene":
        lights = (None if part is None else part[order] for part in (self.lights, self.intensities))
        return Scene(self.images[order], self.mask, *lights)


def scene_for(name: str, count: int, size: int = 24) -> Scene:
    """Return a scene whose lights are given to normal models, which spares the time of estimating them."""
    normals, mask = sphere_normals(size, radius=0.8)
    rng = np.random.default_rng(0)
    lights, gains = hemisphere_lights(count, rng), rng.uniform(0.5, 1.5, count)
    images = shade(normals, lights) * rng.uniform(0.2, 1.0, (size, size, 3)) * gains[:, None, None, None]
    given = (lights, gains) if name in NORMALS else (None, None)
    return Scene(images.astype(np.float32), mask, *given)


def assert_same(first: Estimate, second: Estimate, order: np.ndarray) -> None:
    np.testing.assert_allclose(first.light_directions[order], second.light_directions, atol=1e-4)
    np.testing.assert_allclose(first.intensities[order], second.intensities, atol=1e-4)
    np.testing.assert_allclose(first.normals, second.normals, atol=1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_order_and_chunks_do_not_matter(models: dict[str, TrainedModel], name: str) -> None:
    scene = scene_for(name, 4)
    order = np.array([3, 0, 1, 2])
    reference = combination(models, name).estimate(*scene)
    assert_same(reference, combination(models, name).estimate(*scene.reordered(order)), order)
    assert_same(reference, combination(models, name, chunk_pixels=1).estimate(*scene), np.arange(4))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("count", [1, 3, 7])
def test_any_number_of_images(models: dict[str, TrainedModel], name: str, count: int) -> None:
    scene = scene_for(name, count, 12)
    estimate = combination(models, name).estimate(*scene)
    np.testing.assert_allclose(np.linalg.norm(estimate.normals[scene.mask], axis=-1), 1.0, rtol=1e-4)
    assert estimate.light_directions.shape == (count, 3)
    assert estimate.intensities.shape == (count,)
    assert np.isfinite(estimate.light_directions).all()
    assert (estimate.intensities > 0.0).all()


@pytest.mark.parametrize("index", range(len(NORMALS)))
def test_any_lighting_model_works_with_any_normal_model(models: dict[str, TrainedModel], index: int) -> None:
    pair = {"lighting": models[LIGHTING[index % len(LIGHTING)]], "normals": models[NORMALS[index]]}
    estimate = Estimator(**pair, device=torch.device("cpu"), precision="float32", rotations=1).estimate(
        *scene_for("", 2, 12)
    )
    assert np.isfinite(estimate.normals).all()
    assert len(estimate.light_directions) == len(estimate.intensities) == 2


@pytest.mark.parametrize("name", NORMALS)
@pytest.mark.parametrize(("height", "width"), [(13, 22), (1, 1), (30, 5)])
def test_any_size(models: dict[str, TrainedModel], name: str, height: int, width: int) -> None:
    images = np.random.default_rng(0).random((2, height, width, 3), dtype=np.float32)
    lights = hemisphere_lights(2, np.random.default_rng(1))
    estimate = combination(models, name).estimate(images, np.ones((height, width), bool), lights, np.ones(2))
    assert estimate.normals.shape == (height, width, 3)
    np.testing.assert_allclose(np.linalg.norm(estimate.normals, axis=-1), 1.0, rtol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_black_and_saturated_images_give_finite_estimates(models: dict[str, TrainedModel], name: str) -> None:
    scene = scene_for(name, 3, 12)
    images = scene.images
    for extreme in (0.0 * images, 0.0 * images + 3e4, images * np.array([0, 1e-6, 1e4])[:, None, None, None]):
        estimate = combination(models, name).estimate(*scene.of(extreme.astype(np.float32)))
        for values in (estimate.normals, estimate.light_directions, estimate.intensities):
            assert np.isfinite(values).all()


def stage_of(name: str) -> Stage:
    """Return the stage that trains `name`, with true lights where it can do with them."""
    role = MODELS[name].role
    if role == "lighting":
        return create_stage(name, name, LightingTraining(), {})
    kind = PixelTraining if role == "pixels" else NormalTraining
    return create_stage(name, name, kind(lights=TRUE_LIGHTS if MODELS[name].lights else ""), {})


def difficult_batch(size: int) -> Batch:
    """Return scenes of two images: black, saturated, without an object, black but for noise, and an ordinary one."""
    normals, mask = sphere_normals(size)
    lights = hemisphere_lights(2, np.random.default_rng(0))
    images = torch.from_numpy(shade(normals, lights)).permute(0, 3, 1, 2).repeat(5, 1, 1, 1, 1)
    masks = torch.from_numpy(mask.astype(np.float32)).repeat(5, 1, 1, 1)
    truth = torch.from_numpy(normals).permute(2, 0, 1).repeat(5, 1, 1, 1)
    images[0] = 0.0
    images[1] = Augmentation().clip
    images[2], masks[2], truth[2] = 0.0, 0.0, 0.0
    images[3] = 1e-12 * images[3] - 1e-13
    return Batch(
        images=images,
        mask=masks,
        normals=truth,
        directions=torch.from_numpy(lights).repeat(5, 1, 1),
        intensities=torch.tensor([[0.2, 2.0]]).repeat(5, 1),
        corner=torch.zeros(5, 2, dtype=torch.int64),
        seed=torch.arange(5),
        **distant_layout(images),
    )


@pytest.mark.parametrize("name", MODELS)
def test_gradients_are_finite(name: str) -> None:
    stage = stage_of(name)
    whole = MODELS[name].role == "lighting"  # these work at 128x128 only
    loss, terms = stage.loss(difficult_batch(128 if whole else 32))
    loss.backward()
    assert all(bool(torch.isfinite(value)) for value in (loss, *terms.values()))
    gradients = {part: value.grad for part, value in stage.network.named_parameters() if value.grad is not None}
    assert gradients
    assert [part for part, gradient in gradients.items() if not torch.isfinite(gradient).all()] == []


def test_lighting_branch_sees_single_pixels_in_float32():
    """In bfloat16 a 3x3 convolution over one pixel gets a weight gradient of uninitialised memory on CPUs."""
    network = create("upsfcn-light")
    seen = []
    for layer in network.lighting:
        layer.register_forward_hook(lambda _, inputs, output: seen.append((inputs[0].shape[-1], output.dtype)))
    with torch.autocast("cpu", torch.bfloat16):
        images, mask = torch.rand(2, 3, 3, 32, 32), torch.ones(2, 1, 32, 32, dtype=torch.bool)
        found = network.with_lights(network.observe(images, mask, None))
    sum(part.float().sum() for part in found.lights).backward()
    assert (
        seen
        == [(16, torch.bfloat16), (8, torch.bfloat16), (4, torch.bfloat16), (2, torch.bfloat16)]
        + [(1, torch.float32)] * 2
    )
    assert all(part.grad.isfinite().all() for part in network.lighting.parameters())
