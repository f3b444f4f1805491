"""The network for any light: what must not change its answer, what it learns from, and training through its recipe."""

from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_samples import distant_layout
from sdps_scenes import write_data
from torch import Tensor
from torch.nn import functional

from pipelines.shared import presets
from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.core.first_normals import turn_to_sight
from sdps.core.geometry import Camera, Rig
from sdps.core.lighting import IRRADIANCE, harmonics
from sdps.core.losses import NormalCriterion
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch
from sdps.inference.estimator import Estimator
from sdps.models.anylight import (
    SIDE,
    AnyLightNet,
    image_inputs,
    measure,
    object_places,
    pixel_inputs,
)
from sdps.models.base import Observations, Truth
from sdps.models.blocks import parameter_count
from sdps.models.checkpoint import TrainedModel, load_weights
from sdps.models.registry import MODELS, create
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.stages import leave_out
from sdps.training.trainer import train

SMALL = {"width": 16, "blocks": 2, "heads": 2, "tokens": 3, "channels": 16, "layers": 1, "context": 16}


def observations(images: int, side: int = 16) -> Observations:
    mask = torch.zeros(1, 1, side, side)
    mask[..., 1:-1, 3:-2] = 1.0
    return Observations(torch.rand(1, images, 3, side, side), None, mask)


def sphere(side: int) -> tuple[Tensor, Tensor]:
    """Return normals (1, 3, S, S) of a sphere and its mask."""
    x = (2 * torch.arange(side) + 1) / side - 1
    both = torch.stack([x.expand(side, side), -x[:, None].expand(side, side)])
    squared = both.square().sum(0)
    mask = (squared < 0.85).float()[None, None]
    return torch.cat([both, (1.0 - squared).clamp(min=0.0).sqrt()[None]])[None] * mask, mask


def lit(normals: Tensor, images: int) -> tuple[Tensor, Tensor]:
    """Return images (1, Q, 3, S, S) of a Lambertian surface under two lamps and ambient light, and where from."""
    lamps = torch.randn(images, 2, 3)
    lamps[..., 2] = lamps[..., 2].abs() + 0.3
    lamps = functional.normalize(lamps, dim=-1)
    shading = torch.einsum("qli,bihw->bqlhw", lamps, normals).clamp(min=0.0).sum(2) + 0.2
    inside = normals.norm(dim=1)[:, None]
    return (0.5 * shading * inside)[:, :, None].expand(-1, -1, 3, -1, -1), functional.normalize(lamps.sum(1), dim=-1)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(7)


@pytest.fixture
def trained() -> AnyLightNet:
    """Return a network whose last layers are no longer zero."""
    network = AnyLightNet(**SMALL).eval()
    lasts = [network.offset, network.leave[-1], *(each.answer for each in (*network.listen, *network.attend))]
    for last in (*lasts, *(each.answer for each in network.read.attend)):
        torch.nn.init.normal_(last.weight, std=0.1)
    return network


def test_normals_and_errors_of_any_number_of_images(trained):
    for count in (1, 2, 9):
        with torch.no_grad():
            normals, degrees = trained.regress_with_error(trained.encode(observations(count)))
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(1, 16, 16))
        assert degrees.shape == (1, 1, 16, 16) and (degrees > 0).all()


def test_neither_order_nor_chunks_nor_the_exposures_of_images_matter(trained, monkeypatch):
    monkeypatch.setattr("sdps.models.anylight._STRIP", 64)
    seen, order, exposures = observations(7), torch.randperm(7), torch.rand(1, 7, 1, 1, 1) + 0.2
    parts = [seen._replace(images=seen.images[:, some]) for some in (slice(0, 3), slice(3, 7))]
    with torch.no_grad():
        whole = trained(seen)
        torch.testing.assert_close(trained(seen._replace(images=seen.images[:, order])), whole, atol=1e-4, rtol=0)
        torch.testing.assert_close(trained(seen._replace(images=seen.images * exposures)), whole, atol=1e-4, rtol=0)
        so_far = None
        for part in parts:
            so_far = trained.accumulate(so_far, part)
        chunked = trained.regress(trained.aggregate(so_far))
    torch.testing.assert_close(chunked, whole, atol=0.02, rtol=0)  # images are kept in 16 bits
    torch.testing.assert_close(trained(seen).detach(), whole, atol=1e-4, rtol=0)  # with gradients
    assert (trained(observations(7)) - whole).abs().max() > 0.01


def test_the_background_is_not_seen_and_padding_changes_no_pixel_alone(trained):
    seen = observations(5)
    other = seen._replace(images=torch.where(seen.mask[:, None] > 0.5, seen.images, 9.0))
    padded = Observations(*(functional.pad(each, (0, 8, 0, 16)) for each in (seen.images,)), None,
                          functional.pad(seen.mask, (0, 8, 0, 16)))  # fmt: skip
    with torch.no_grad():
        torch.testing.assert_close(trained(other), trained(seen), atol=1e-5, rtol=0)
    torch.testing.assert_close(measure(padded.images, padded.mask), measure(seen.images, seen.mask))
    there = object_places(padded.mask)[..., :16, :16]
    torch.testing.assert_close(there, object_places(seen.mask))


def test_a_mask_without_pixels_gives_a_map(trained):
    seen = observations(4)
    with torch.no_grad():
        assert torch.isfinite(trained(seen._replace(mask=torch.zeros_like(seen.mask)))).all()


def test_a_black_image_among_bright_ones_blows_nothing_up():
    """Its mean is that of its noise, next to zero: divided by that, training once became NaN."""
    mask = torch.ones(1, 1, 16, 16)
    images = torch.rand(1, 5, 3, 16, 16)
    images[:, 1] = 0.01 * torch.randn(1, 3, 16, 16)
    images[:, 1] -= images[:, 1].mean()
    levels = measure(images, mask)
    read = image_inputs(images, mask, object_places(mask), levels[..., 0])
    seen, known = pixel_inputs(images[0].flatten(2).permute(2, 0, 1), levels[0], object_places(mask)[0].flatten(1).T)
    assert max(float(part.abs().max()) for part in (read, seen, known)) < 10.0


def test_large_images_are_read_small():
    mask = torch.ones(1, 1, 300, 200)
    images = torch.rand(1, 2, 3, 300, 200)
    read = image_inputs(images, mask, object_places(mask), measure(images, mask)[..., 0])
    assert read.shape == (1, 2, 9, SIDE, 88)


def test_a_pixel_shows_no_albedo():
    values, levels = torch.rand(20, 6, 3), torch.tensor([[0.4, 1.0]]).expand(6, 2)
    places = torch.zeros(20, 2)
    one, other = (pixel_inputs(each, levels, places)[0][..., :3] for each in (values, 0.3 * values))
    torch.testing.assert_close(one, other, rtol=0.05, atol=0.01)


def test_gradients_reach_everything_under_bfloat16(trained):
    seen = observations(5)
    normals = functional.normalize(torch.randn(1, 3, 16, 16), dim=1) * seen.mask
    truth = Truth(normals, seen.mask, functional.normalize(torch.randn(1, 5, 3), dim=-1), torch.ones(1, 5),
                  torch.randn(1, 5, 9))  # fmt: skip
    for parameter in trained.surroundings.leave.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    with torch.autocast("cpu", torch.bfloat16):
        loss, terms = trained.loss(seen, truth, NormalCriterion("chord", shading_weight=0.1))
    loss.backward()
    assert {"pixel_loss", "expected_loss", "lighting_loss", "shading_loss"} <= terms.keys()
    still = [name for name, each in trained.named_parameters() if each.grad is None or not each.grad.abs().any()]
    assert not still


def test_it_learns_a_sphere_under_lamps_and_ambient_light():
    network = AnyLightNet(**SMALL)
    normals, mask = sphere(16)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3)
    first = last = 0.0
    for _ in range(60):
        images, towards = lit(normals, 5)
        truth = Truth(normals, mask, towards[None], torch.ones(1, 5), harmonics(towards)[None])
        loss, terms = network.loss(Observations(images, None, mask), truth, NormalCriterion("chord"))
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        last = float(terms["masked_loss"].detach())
        first = first or last
    assert last < 0.25 * first


def test_harmonics_are_orthonormal_and_shade_as_lambert_does():
    vectors = functional.normalize(torch.randn(200_000, 3), dim=-1)
    basis = harmonics(vectors)
    torch.testing.assert_close(basis.T @ basis / len(basis), torch.eye(9), atol=0.02, rtol=0)
    lamp, normals = functional.normalize(torch.randn(3), dim=0), vectors[:500]
    shown = harmonics(normals) * torch.tensor(IRRADIANCE) @ harmonics(lamp) / 4
    assert (shown - (normals @ lamp).clamp(min=0.0)).abs().mean() < 0.04  # 0.03: of order two


@pytest.mark.parametrize("views", [1, 8])
def test_a_pinhole_camera_turns_the_normals_with_its_lines_of_sight(trained, views):
    model = TrainedModel("anylight", trained, SMALL, {"config": {"augmentation": to_plain(Augmentation())}})
    estimator = Estimator(
        lighting=None, normals=model, device=torch.device("cpu"), precision="float32", normal_views=views
    )
    images, mask = np.random.default_rng(0).random((4, 24, 24, 3)), np.ones((24, 24), bool)
    camera = Camera(20.0)
    flat, seen = (estimator.estimate(images, mask, rig=rig).normals for rig in (Rig(), Rig(camera)))
    sights = torch.from_numpy(camera.sights(mask.shape)).float()
    turned = torch.from_numpy(flat)[..., None, :] @ turn_to_sight(sights)
    np.testing.assert_allclose(seen, turned[..., 0, :].numpy(), atol=1e-3)
    assert np.abs(seen - flat).max() > 0.1


def test_size_and_options():
    assert parameter_count(create("anylight")) == MODELS["anylight"].parameters <= 5_000_000
    for options in ({"width": 0}, {"blocks": 0}, {"layers": -1}):
        with pytest.raises(InputError, match="must be at least 1"):
            AnyLightNet(**options)
    for options in ({"heads": 5}, {"attending": 4}):
        with pytest.raises(InputError, match="heads must divide width and channels"):
            AnyLightNet(**options)


def test_the_preset_builds_and_each_step_draws_its_number_of_images():
    run = presets.load("anylight").run("anylight-leg-1")
    stage = create_stage("one", run.model, run.config, {})
    assert stage.lighting is None and run.config.augmentation.mixed.sparse
    seen, drawn = observations(8), set()
    for seed in range(20):
        corner, own = torch.zeros(1, 2, dtype=torch.int64), torch.tensor([seed])
        batch = Batch(seen.images, seen.mask, seen.images[:, 0], torch.zeros(1, 8, 3), torch.ones(1, 8), corner, own,
                      **distant_layout(seen.images))  # fmt: skip
        fewer = leave_out(batch, 5)
        drawn.add(fewer.images.shape[1])
        assert (
            fewer.directions.shape[1] == fewer.intensities.shape[1] == fewer.nearness.shape[1] == fewer.images.shape[1]
        )
    assert drawn == {5, 6, 7, 8}


def test_training_through_the_recipe(tmp_path: Path) -> None:
    write_data(tmp_path / "data", ("train", "train", "val"), lights=6, size=32)
    mixed = {"sparse": True, "single": 0.3, "surrounded": 0.3, "steady": 0.5}
    settings = {"base": "anylight", "steps": 3, "batch_scenes": 2, "images": 5, "fewest_images": 3, "size": 32,
                "workers": 0, "log_every": 1, "cache": False, "options": SMALL, "loss": "chord",
                "augmentation": {"noise": 0.0, "mixed": mixed}}  # fmt: skip
    run = recipes.run("tiny", {}, {"tiny": settings})
    result = train(create_stage("tiny", run.model, run.config, {}), tmp_path / "data", tmp_path / "out", device="cpu")
    assert result.steps == 3 and {"val_normal_mae", "val_normal_mae_single"} <= result.metrics.keys()
    model = load_weights(result.weights["tiny"])
    assert model.name == "anylight" and not model.network.needs_lights
