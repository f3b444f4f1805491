"""CNN-PS: observation maps against a loop, rotations, the network, drawing of pixels, training and bad input."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from sdps_samples import distant_layout
from sdps_scenes import hemisphere_lights, shade, sphere_normals
from torch import Tensor, nn

from render.shared.errors import InputError
from sdps.core.lighting import LightClasses
from sdps.core.metrics import angle_degrees, normal_mae
from sdps.data.dataset import Batch
from sdps.models.base import Lights
from sdps.models.blocks import parameter_count
from sdps.models.cnnps import CNNPS, MAP_SIDE, observation_maps, predict_normals, rotate_about_view
from sdps.training.pixel_stage import PixelStage, draw_lights, draw_pixels, sample_pixels
from sdps.training.training_config import PixelTraining

CONFIG = PixelTraining(images=12, batch_scenes=2, pixels_per_scene=6, min_lights=4, rotations=4)


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    torch.manual_seed(0)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so little work that sharing it costs more
    yield
    torch.set_num_threads(threads)


def random_lights(*shape: int) -> Tensor:
    """Return unit directions (..., 3) over the hemisphere towards the camera."""
    lights = torch.randn(*shape, 3)
    lights[..., 2] = lights[..., 2].abs()
    return nn.functional.normalize(lights, dim=-1)


def random_valid(pixels: int, lights: int) -> Tensor:
    valid = torch.rand(pixels, lights) < 0.6
    valid[:, 0] = True
    return valid


def sphere_batch(scenes: int = 2, lights: int = 12, size: int = 32) -> Batch:
    """Return Lambertian spheres under random intensities, without noise; the last pixel rows are background."""
    normals, mask = sphere_normals(size)
    directions = np.stack([hemisphere_lights(lights, np.random.default_rng(index)) for index in range(scenes)])
    images = np.stack([shade(normals, one, [0.2, 0.5, 0.8]) for one in directions]).transpose(0, 1, 4, 2, 3)
    intensities = torch.rand(scenes, lights) * 1.8 + 0.2
    return Batch(
        images=torch.from_numpy(images) * intensities[..., None, None, None],
        mask=torch.from_numpy(mask).float().expand(scenes, 1, -1, -1),
        normals=torch.from_numpy(normals).permute(2, 0, 1).expand(scenes, -1, -1, -1),
        directions=torch.from_numpy(directions),
        intensities=intensities,
        corner=torch.zeros(scenes, 2, dtype=torch.int64),
        seed=torch.arange(scenes),
        **distant_layout(torch.from_numpy(images)),
    )


def true_lights(batch: Batch) -> Lights:
    return Lights(batch.directions, batch.intensities)


class Lambert(nn.Module):
    """Reads the normal off a map by least squares over its filled cells: exact for Lambertian pixels, up to cells."""

    def __init__(self) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(1))

    def forward(self, maps: Tensor) -> Tensor:
        axis = (torch.arange(MAP_SIDE) + 0.5) / (MAP_SIDE - 1) * 2.0 - 1.0
        x, y = torch.meshgrid(axis, axis, indexing="ij")
        lights = torch.stack([x, y, (1.0 - x**2 - y**2).clamp(min=0.0).sqrt()], dim=-1).view(-1, 3)
        normals = [torch.linalg.lstsq(lights[one > 0], one[one > 0][:, None]).solution[:, 0] for one in maps.flatten(1)]
        return nn.functional.normalize(torch.stack(normals), dim=1)


def test_maps_equal_a_loop_over_pixels_and_lights() -> None:
    values = torch.rand(5, 40) * torch.tensor([1.0, 1e-4, 1e4, 1.0, 0.0])[:, None]
    valid = random_valid(5, 40)
    for directions in (random_lights(5, 40), random_lights(40), random_lights(1).expand(40, -1)):
        expected = np.zeros((5, MAP_SIDE, MAP_SIDE))
        for pixel in range(5):
            cells: dict[tuple[int, int], list[float]] = {}
            peak = max(float(value) for value, use in zip(values[pixel], valid[pixel], strict=True) if use)
            for light in range(40):
                x, y, _ = (directions[pixel] if directions.ndim == 3 else directions)[light].tolist()
                if valid[pixel, light] and peak:
                    cell = int(0.5 * (x + 1) * (MAP_SIDE - 1)), int(0.5 * (y + 1) * (MAP_SIDE - 1))
                    cells.setdefault(cell, []).append(float(values[pixel, light]) / peak)
            for cell, shares in cells.items():
                expected[pixel][cell] = np.mean(shares)
        maps = observation_maps(values, directions, valid)
        assert maps.shape == (5, 1, MAP_SIDE, MAP_SIDE) and maps.dtype == torch.float32
        np.testing.assert_allclose(maps[:, 0].numpy(), expected, atol=1e-6)


def test_maps_ignore_the_order_of_lights_scale_and_lights_not_valid() -> None:
    values, directions, valid = torch.rand(6, 30), random_lights(6, 30), random_valid(6, 30)
    maps, order = observation_maps(values, directions, valid), torch.randperm(30)
    torch.testing.assert_close(observation_maps(values[:, order], directions[:, order], valid[:, order]), maps)
    torch.testing.assert_close(observation_maps(1e-6 * values, directions, valid), maps)
    others = torch.where(valid, values, torch.full_like(values, math.nan))
    torch.testing.assert_close(observation_maps(others, directions, valid), maps)


def test_lights_on_the_rim_and_behind_stay_on_the_map() -> None:
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.001, 0.0, 0.0]])
    maps = observation_maps(torch.ones(1, 5), directions, torch.ones(1, 5, dtype=torch.bool))[0, 0]
    assert {tuple(cell) for cell in maps.nonzero().tolist()} == {(31, 15), (15, 31), (0, 15), (15, 15)}


def test_a_quarter_turn_of_the_lights_turns_the_map() -> None:
    values, directions, valid = torch.rand(4, 50), random_lights(4, 50), random_valid(4, 50)
    straight = observation_maps(values, directions, valid)
    turned = observation_maps(values, rotate_about_view(directions, 0.5 * math.pi), valid)
    # Cell 31 belongs to the coordinate 1 alone, so that cells 0 to 30 are what is symmetric.
    torch.testing.assert_close(turned[..., :31, :31], straight[..., :31, :31].rot90(1, (-2, -1)))


def test_rotation_goes_from_x_to_y_and_back() -> None:
    x = torch.tensor([[1.0, 0.0, 0.5]])
    torch.testing.assert_close(rotate_about_view(x, 0.5 * math.pi), torch.tensor([[0.0, 1.0, 0.5]]))
    vectors, angles = torch.randn(5, 3, 3), torch.rand(5)
    there = rotate_about_view(vectors, angles[:, None])
    torch.testing.assert_close(rotate_about_view(there, -angles[:, None]), vectors)
    torch.testing.assert_close(rotate_about_view(vectors[2], float(angles[2])), there[2])


def test_averaged_estimates_turn_with_the_lights() -> None:
    network = CNNPS().eval()
    values, directions, valid = torch.rand(5, 30), random_lights(30), random_valid(5, 30)
    turn = 2.0 * math.pi / 5
    with torch.no_grad():
        straight = predict_normals(network, values, directions, valid, rotations=5)
        turned = predict_normals(network, values, rotate_about_view(directions, turn), valid, rotations=5)
        once = predict_normals(network, values, rotate_about_view(directions, turn), valid, rotations=1)
    torch.testing.assert_close(turned, rotate_about_view(straight, turn), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(straight.norm(dim=1), torch.ones(5))
    assert (once - rotate_about_view(straight, turn)).abs().max() > 0.01  # the average is what does it


def test_the_network_has_the_published_layers() -> None:
    network = CNNPS()
    assert parameter_count(network) == 2_654_051
    assert parameter_count(network.hidden) == 2_621_568
    normals = network(torch.rand(3, 1, MAP_SIDE, MAP_SIDE))
    assert normals.dtype == torch.float32
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(3))
    with torch.autocast("cpu", torch.bfloat16):
        assert network(torch.rand(3, 1, MAP_SIDE, MAP_SIDE)).dtype == torch.float32


def test_black_saturated_and_no_pixels_keep_gradients_finite() -> None:
    network = CNNPS()
    values = torch.stack([torch.zeros(20), torch.full((20,), 4.0), torch.full((20,), -0.1), torch.rand(20) * 1e-30])
    values.requires_grad_()
    for rows in (slice(0, 4), slice(0, 0)):
        maps = observation_maps(values[rows], random_lights(20), torch.ones_like(values[rows], dtype=torch.bool))
        loss = network(maps).square().sum() + maps.sum()
        loss.backward()
        assert torch.isfinite(loss) and torch.isfinite(values.grad).all()
        assert all(torch.isfinite(parameter.grad).all() for parameter in network.parameters())
    with torch.no_grad():
        normals = predict_normals(network.eval(), values, random_lights(20), torch.ones(4, 20, dtype=torch.bool))
    torch.testing.assert_close(normals[[0, 2]], torch.tensor([[0.0, 0.0, 1.0]] * 2))
    assert torch.isfinite(normals).all()


def estimated_normals(images: np.ndarray, mask: np.ndarray, lights: np.ndarray, rotations: int) -> np.ndarray:
    """Return the normals (H, W, 3) that `Lambert` reads off the maps of the object's pixels."""
    values = torch.from_numpy(images[:, mask].mean(-1).T)
    normals = np.zeros((*mask.shape, 3), np.float32)
    valid = torch.ones_like(values, dtype=torch.bool)
    normals[mask] = predict_normals(Lambert(), values, torch.from_numpy(lights), valid, rotations=rotations)
    return normals


def test_normals_of_a_lambertian_sphere_whatever_its_scale_and_colour() -> None:
    normals, mask = sphere_normals(24)
    lights = hemisphere_lights(60, np.random.default_rng(0))
    images = shade(normals, lights, [0.2, 0.5, 0.8])
    whole = estimated_normals(images, mask, lights, 2)
    np.testing.assert_allclose(estimated_normals(images * np.float32(1e-3), mask, lights, 2), whole, atol=1e-4)
    # Attached shadows leave fewer lights towards the rim, and a cell is 3.7 degrees wide.
    assert normal_mae(whole, normals, mask) < 3.0


def test_colliding_lights_lose_nothing() -> None:
    """Lambertian normals stay readable where lights are known by classes of 10 degrees only, many of them in a cell."""
    normals, mask = sphere_normals(16)
    lights = hemisphere_lights(200, np.random.default_rng(0), lowest=0.5)
    classes = LightClasses(directions=18)
    labels = classes.encode(torch.from_numpy(lights), torch.ones(200))
    estimated, _ = classes.decode(*labels)
    result = estimated_normals(shade(normals, lights), mask, estimated.numpy(), 4)
    assert normal_mae(result, normals, mask) < 1.5


def test_drawn_pixels_show_what_their_lights_give() -> None:
    batch = sphere_batch()
    pixels = draw_pixels(batch, true_lights(batch), [3, 4], count=50, min_lights=4)
    assert pixels.values.shape == pixels.valid.shape == (100, 12) and pixels.directions.shape == (100, 12, 3)
    expected = 0.5 * torch.einsum("nqc,nc->nq", pixels.directions, pixels.normals).clamp(min=0.0)
    torch.testing.assert_close(pixels.values, expected, atol=1e-5, rtol=1e-4)
    brighter = draw_pixels(batch, Lights(batch.directions, 2.0 * batch.intensities), [3, 4], count=50, min_lights=4)
    torch.testing.assert_close(brighter.values, 0.5 * pixels.values)
    counts = pixels.valid.sum(1)
    assert counts.min() >= 4 and counts.max() <= 12 and len(counts.unique()) > 4
    assert pixels.normals[:50, :2].mean(0).norm() < 0.3


def test_a_scene_s_draw_depends_on_its_seed_alone() -> None:
    batch = sphere_batch()
    both = draw_pixels(batch, true_lights(batch), [3, 0], count=8, min_lights=4)
    second = Batch(*(tensor[1:] for tensor in batch))
    torch.rand(7)
    alone = draw_pixels(second, true_lights(second), [0], count=8, min_lights=4)
    other = draw_pixels(second, true_lights(second), [1], count=8, min_lights=4)
    for part, whole in zip(alone, both, strict=True):
        assert torch.equal(part, whole[8:])
    assert not torch.equal(other.normals, alone.normals)


def test_light_subsets_are_cut_by_elevation_and_keep_a_minimum() -> None:
    directions = random_lights(64)
    angles = torch.rad2deg(directions[:, 2].acos())
    valid = draw_lights(directions, 400, 5, torch.Generator().manual_seed(0))
    assert valid.sum(1).min() >= 5 and valid.sum(1).max() > 40
    share = valid.float().mean(0)
    assert share[angles < 20].mean() > 2.0 * share[angles > 80].mean() > 0.0
    few = draw_lights(directions[:3], 10, 3, torch.Generator().manual_seed(0))
    assert few.all()
    low = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.01], [0.0, 1.0, 0.02], [1.0, 1.0, 0.0]]), dim=1)
    assert draw_lights(low, 50, 2, torch.Generator().manual_seed(0)).sum(1).min() == 2


def test_validation_pixels_spread_over_the_object() -> None:
    batch = sphere_batch(size=16)
    inside = int(batch.mask[0].sum())
    pixels = sample_pixels(batch, true_lights(batch), 10_000)
    assert len(pixels.normals) == 2 * inside and pixels.valid.all()
    some = sample_pixels(batch, true_lights(batch), 20)
    assert len(some.normals) == 40 and len(some.normals[:20].unique(dim=0)) == 20
    assert some.normals[:20, 1].max() > 0.8 and some.normals[:20, 1].min() < -0.8


def test_the_stage_trains_and_validates_also_without_object_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sdps.training.pixel_stage.VALIDATION_PIXELS", 8)
    stage, batch = PixelStage(CONFIG), sphere_batch()
    assert stage.goal == "normal_mae" and stage.origin() == {"lights": "true"}
    half = batch.mask * torch.tensor([1.0, 0.0]).view(2, 1, 1, 1)
    changes = ({}, {"mask": half}, {"mask": 0.0 * half}, {"images": 0.0 * batch.images})
    for scenes in (batch._replace(**change) for change in changes):
        stage.network.train()
        loss, _ = stage.loss(scenes)
        loss.backward()
        assert torch.isfinite(loss)
        assert all(torch.isfinite(parameter.grad).all() for parameter in stage.network.parameters())
        stage.network.eval()
        with torch.no_grad():
            values = stage.metrics(scenes)
        assert all(math.isfinite(value) for value in values.values()) and "normal_mae" in values


def test_the_loss_of_a_batch_is_the_mean_of_its_scenes_losses() -> None:
    stage, batch = PixelStage(CONFIG), sphere_batch()
    stage.network.eval()  # dropout draws across the batch
    with torch.no_grad():
        parts = [stage.loss(Batch(*(tensor[index : index + 1] for tensor in batch)))[0] for index in range(2)]
        torch.testing.assert_close(stage.loss(batch)[0], torch.stack(parts).mean())


def test_it_learns_lambertian_pixels() -> None:
    network = CNNPS().to(memory_format=torch.channels_last)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    every = torch.ones(40, 40, dtype=torch.bool)

    def draw() -> tuple[Tensor, Tensor, Tensor]:
        normals, directions = random_lights(40), random_lights(40, 40)
        shading = torch.einsum("nqc,nc->nq", directions, normals).clamp(min=0.0)
        return shading * torch.rand(40, 1), directions, normals

    for _ in range(20):
        values, directions, normals = draw()
        loss = (network(observation_maps(values, directions, every)) - normals).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    values, directions, normals = draw()
    with torch.no_grad():
        estimate = predict_normals(network.eval(), values, directions, every, rotations=2)
    constant = angle_degrees(np.array([[0.0, 0.0, 1.0]]), normals.numpy()).mean()
    error = angle_degrees(estimate.numpy(), normals.numpy()).mean()
    assert error < 0.5 * constant, f"{error:.1f} against {constant:.1f} degrees of the constant"


@pytest.mark.parametrize(
    ("values", "directions", "valid", "message"),
    [
        (torch.ones(2, 0), torch.ones(0, 3), torch.ones(2, 0, dtype=torch.bool), "Q >= 1"),
        (torch.ones(2, 4), torch.ones(5, 3), torch.ones(2, 4, dtype=torch.bool), r"directions of shape \(4, 3\)"),
        (torch.ones(2, 4), torch.ones(4, 2), torch.ones(2, 4, dtype=torch.bool), r"got \(4, 2\)"),
        (torch.ones(2, 4), torch.ones(4, 3), torch.ones(2, 4), "valid must be bool"),
    ],
)
def test_maps_refuse_shapes_that_do_not_belong_together(
    values: Tensor, directions: Tensor, valid: Tensor, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        observation_maps(values, directions, valid)
    assert "\n" not in str(caught.value)
