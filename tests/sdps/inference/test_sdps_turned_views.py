"""Turning scenes: the way back, arrays and tensors alike, and what averaging over views gives."""

import numpy as np
import pytest
import torch

from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.core.metrics import angle_degrees
from sdps.core.symmetry import SYMMETRIES, Symmetry
from sdps.inference.estimator import Estimator
from sdps.inference.turned_views import mean_lights, turn_lights
from sdps.models.base import Lights
from sdps.models.checkpoint import TrainedModel
from sdps.models.registry import create
from sdps.training.training_config import LightingTraining

EVERY = pytest.mark.parametrize("symmetry", SYMMETRIES)


@EVERY
def test_every_symmetry_turns_arrays_and_tensors_alike_and_has_a_way_back(symmetry: Symmetry) -> None:
    rng = np.random.default_rng(0)
    images, normals = rng.random((2, 6, 6, 3)), rng.standard_normal((6, 6, 3))
    directions = rng.standard_normal((2, 3))
    turned = symmetry.images(images, 1), symmetry.vectors(symmetry.images(normals, 0)), symmetry.vectors(directions)
    stack, map_, lights = (
        torch.tensor(images).movedim(-1, 1),
        torch.tensor(normals).movedim(-1, 0),
        torch.tensor(directions),
    )
    np.testing.assert_array_equal(symmetry.images(stack).movedim(1, -1), turned[0])
    np.testing.assert_array_equal(symmetry.vectors(symmetry.images(map_), dim=0).movedim(0, -1), turned[1])
    np.testing.assert_array_equal(symmetry.vectors(lights), turned[2])
    assert torch.equal(symmetry.back.images(symmetry.images(stack)), stack)
    assert torch.equal(symmetry.back.vectors(symmetry.vectors(lights)), lights)


def test_the_first_views_are_groups_and_all_are_different() -> None:
    probe = torch.arange(9.0).reshape(3, 3)
    seen = [tuple(symmetry.images(probe).flatten().tolist()) for symmetry in SYMMETRIES]
    assert len(set(seen)) == 8
    for count in (1, 2, 4, 8):
        products = {
            tuple(b.images(a.images(probe)).flatten().tolist()) for a in SYMMETRIES[:count] for b in SYMMETRIES[:count]
        }
        assert products == set(seen[:count])


def test_the_mean_of_lights_undoes_the_turns() -> None:
    true = torch.nn.functional.normalize(torch.rand(1, 4, 3), dim=-1)
    gains, sides = torch.rand(1, 4), torch.rand(1, 4, 2, 3)
    spread = sides.transpose(-1, -2) @ sides
    lights = Lights(true, *[gains] * 4, covariance=spread)
    turned = [turn_lights(symmetry, lights) for symmetry in SYMMETRIES]
    for symmetry, found in zip(SYMMETRIES, turned, strict=True):
        own = symmetry.vectors(sides)
        torch.testing.assert_close(found.covariance, own.transpose(-1, -2) @ own)
    for one, two in zip(mean_lights(list(zip(SYMMETRIES, turned, strict=True))), lights, strict=True):
        torch.testing.assert_close(one, two)


def test_the_mean_of_views_is_expected_to_err_less_by_what_averages_out() -> None:
    """Views err by 3 degrees together and by 4 each for itself: 5 in all, and sqrt(3^2 + 4^2 / 8) the mean."""
    rng, common, own = torch.Generator().manual_seed(0), 3.0, 4.0
    noise = torch.randn(8, 1, 4000, 2, generator=rng) * torch.deg2rad(torch.tensor(own)) / 2**0.5
    noise[..., 0] += torch.deg2rad(torch.tensor(common))
    directions = torch.nn.functional.normalize(torch.cat([noise, torch.ones(8, 1, 4000, 1)], dim=-1), dim=-1)
    gains, each_error = torch.ones(1, 4000), torch.full((1, 4000), 5.0)
    views = zip(SYMMETRIES, directions, strict=True)
    mean = mean_lights([(each, Lights(each.vectors(one), gains, expected_error=each_error)) for each, one in views])
    made = angle_degrees(mean.directions.numpy(), np.array([0.0, 0.0, 1.0]))
    assert mean.expected_error is not None
    assert float(mean.expected_error.square().mean().sqrt()) == pytest.approx(
        float(np.sqrt((made**2).mean())), rel=0.03
    )
    assert float(mean.expected_error.min()) > 4.99 / 8**0.5


def estimator(lights: int, normals: int) -> Estimator:
    torch.manual_seed(0)
    metadata = {"config": to_plain(LightingTraining())}
    names = {"lighting": "lcnet-soft", "normals": "nenet"}
    models = {place: TrainedModel(name, create(name).eval(), {}, metadata) for place, name in names.items()}
    views = {"light_views": lights, "normal_views": normals}
    return Estimator(**models, device=torch.device("cpu"), precision="float32", read_out="expectation", **views)


def differences(network: Estimator) -> tuple[float, float]:
    """Return by how many degrees lights, and normals under given lights, change when the camera is turned."""
    rng = np.random.default_rng(0)
    images, mask = rng.random((3, 48, 40, 3)).astype(np.float32), np.zeros((48, 40), bool)
    mask[4:44, 8:36] = True
    given, quarter = torch.tensor([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]), Symmetry(1)
    turned_images, turned_mask = np.rot90(images, 1, (1, 2)), np.rot90(mask)
    lights = network.estimate_lights(images, mask).light_directions
    found = network.estimate_lights(turned_images, turned_mask).light_directions
    normals = network.estimate(images, mask, given.numpy(), np.ones(3)).normals
    turned = network.estimate(turned_images, turned_mask, quarter.vectors(given).numpy(), np.ones(3)).normals
    back = quarter.back.vectors(torch.from_numpy(np.rot90(turned, -1).copy())).numpy()
    lit = angle_degrees(quarter.back.vectors(torch.from_numpy(found)).numpy(), lights).max()
    return float(lit), float(np.median(angle_degrees(back[mask], normals[mask])))


def test_all_views_together_do_not_care_how_the_object_lies() -> None:
    apart, level = differences(estimator(1, 1)), differences(estimator(8, 8))
    assert min(apart) > 1.0
    assert max(level) < 0.1 * min(apart)


def test_numbers_of_views_that_are_no_group_are_refused() -> None:
    with pytest.raises(InputError, match="light_views must be 1, 2, 4 or 8, got 3"):
        estimator(3, 1)
    with pytest.raises(InputError, match="normal_views must be 1, 2, 4 or 8, got 0"):
        estimator(1, 0)
