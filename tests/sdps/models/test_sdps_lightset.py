"""The lighting network whose images meet at every stage."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from render.shared.errors import InputError
from sdps.inference.chunked import lighting_prediction
from sdps.models.base import Lights
from sdps.models.blocks import parameter_count
from sdps.models.lightset import LightSetNet, SetPrediction, image_inputs
from sdps.models.registry import MODELS


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(5)


@pytest.fixture
def network() -> LightSetNet:
    return LightSetNet(width=32, blocks=2, heads=2).eval()


def scene(images: int = 5) -> tuple[Tensor, Tensor]:
    """Return random images (1, Q, 3, 128, 128) and a mask that leaves a border."""
    mask = torch.zeros(1, 1, 128, 128)
    mask[..., 10:-20, 16:-8] = 1.0
    return torch.rand(1, images, 3, 128, 128), mask


class Chunks:
    """A view of images in chunks of two."""

    def __init__(self, images: Tensor, mask: Tensor) -> None:
        self.images, self.mask = images, mask

    def __len__(self) -> int:
        return self.images.shape[1]

    def __iter__(self):
        for start in range(0, len(self), 2):
            part = slice(start, min(start + 2, len(self)))
            yield part, self.images[:, part]


def test_it_has_the_parameters_of_the_registry():
    assert parameter_count(LightSetNet()) == MODELS["lightset"].parameters


def test_the_order_of_the_images_does_not_matter(network):
    images, mask = scene()
    order = torch.tensor([3, 0, 4, 1, 2])
    with torch.no_grad():
        one, other = network(images, mask), network(images[:, order], mask)
    for first, second in zip(one, other, strict=True):
        torch.testing.assert_close(first[:, order], second, atol=1e-5, rtol=1e-4)


def test_chunks_give_what_all_images_at_once_give(network):
    images, mask = scene()
    with torch.inference_mode():
        found = lighting_prediction(network, Chunks(images, mask), torch.inference_mode)
        whole = network(images, mask)
    for first, second in zip(found, whole, strict=True):
        torch.testing.assert_close(first, second, atol=1e-5, rtol=1e-4)


def test_many_images_meet_in_groups_that_share_one_scale(network, monkeypatch):
    images, mask = scene(7)
    with torch.no_grad():
        local = network.encode(images, mask)
        together = network.predict(local, local)
        for first, second in zip(network.predict_parts([local], 0), together, strict=True):
            torch.testing.assert_close(first, second)  # too few to be parted
        monkeypatch.setattr("sdps.models.lightset._TOGETHER", 3)
        found, again, other = (network.predict_parts([local], seed) for seed in (0, 0, 1))
        order = torch.randperm(7, generator=torch.Generator().manual_seed(0))
        groups = [network.predict(local[:, part], local) for part in order.tensor_split(2)]
    for part, group in zip(order.tensor_split(2), groups, strict=True):
        ratio = found.intensities[:, part] / group.intensities
        torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio))  # a group keeps its own proportions
        logs = (found.intensities[:, part].log().mean(), together.intensities[:, part].log().mean())
        torch.testing.assert_close(*logs)  # at the scale of all
    torch.testing.assert_close(found.directions[:, order], torch.cat([group.directions for group in groups], dim=1))
    torch.testing.assert_close(found.expected[:, order], torch.cat([group.expected for group in groups], dim=1))
    torch.testing.assert_close(found.directions, again.directions)
    assert (found.directions - other.directions).abs().max() > 1e-4


def test_how_far_light_spreads_is_learned_and_told():
    network, (images, mask) = LightSetNet(width=32, blocks=2, heads=2, covariance=True).eval(), scene()
    with torch.no_grad():
        told = network.read_lights(network(images, mask)).covariance
    assert told is not None and not told.any(), "training begins at single lamps"
    all_around = torch.eye(3).expand(1, 5, 3, 3)
    truth = Lights(functional.normalize(torch.randn(1, 5, 3), dim=-1), torch.ones(1, 5), covariance=all_around)
    terms = network.loss(network(images, mask), truth)
    assert float(terms["covariance"]) == pytest.approx(3**0.5, abs=1e-3)
    terms["covariance"].backward()
    assert network.about.bias.grad[[0, 3, 5]].lt(0.0).all() and network.about.bias.grad[[1, 2, 4]].abs().max() < 1e-6
    torch.nn.init.normal_(network.about.weight)
    with torch.no_grad():
        found = network(images, mask)
        parts = network.predict_parts([network.encode(images, mask)], 0)
    torch.testing.assert_close(found.covariance, found.covariance.transpose(-1, -2))
    torch.testing.assert_close(parts.covariance, found.covariance)


def test_images_of_any_side_are_seen_alike(network):
    images, mask = scene(2)
    small = [functional.avg_pool2d(part.flatten(0, 1), 2) for part in (images * mask[:, None], mask[:, None])]
    assert torch.equal(small[1] > 0, small[1] == 1)  # the mask's border lies on even pixels
    with torch.no_grad():
        one, other = network.encode(images, mask), network.encode(small[0][None], small[1])
    torch.testing.assert_close(one, other)


def test_albedo_does_not_change_the_shading():
    local = torch.rand(1, 6, 4, 64, 64) + 0.3
    local[:, :, 3] = 1.0
    painted = local.clone()
    painted[:, :, :3] *= torch.rand(1, 1, 1, 64, 64) + 0.5
    (one, alike), (other, painted_alike) = image_inputs(local), image_inputs(painted)
    torch.testing.assert_close(one[:, :, 3], other[:, :, 3], atol=0.02, rtol=0.02)  # but for the floor
    torch.testing.assert_close(alike, painted_alike, atol=0.02, rtol=0.02)


def test_images_that_look_alike_are_told_so():
    local = torch.rand(1, 3, 4, 64, 64)
    local[:, :, 3] = 1.0
    local[:, 1, :3] = 0.5 * local[:, 0, :3]
    _, alike = image_inputs(local)
    assert alike[0, 0, 1].min() > 0.97 and alike[0, 0, 2, 1] < 0.5


def test_what_lies_off_the_object_is_not_seen(network):
    images, mask = scene()
    elsewhere = images + (1 - mask[:, None]) * torch.rand_like(images)
    with torch.no_grad():
        for first, second in zip(network(images, mask), network(elsewhere, mask), strict=True):
            torch.testing.assert_close(first, second)


@pytest.mark.parametrize("values", [0.0, -0.01])
def test_black_images_have_a_light(network, values):
    images, mask = scene()
    with torch.no_grad():
        prediction = network(torch.full_like(images, values), mask)
    assert all(torch.isfinite(part).all() for part in prediction)


def test_the_scale_of_intensities_costs_nothing_and_the_ratios_do(network):
    directions = functional.normalize(torch.randn(1, 4, 3), dim=-1)
    strengths = torch.tensor([[0.3, 0.6, 1.2, 0.9]])
    lamps = torch.zeros(1, 4), torch.zeros(1, 4, 3, 3)
    prediction = SetPrediction(directions, strengths, torch.full((1, 4), 0.1), *lamps)
    alike, other = (
        network.loss(prediction, Lights(directions, scale * torch.tensor([[0.3, 0.6, 1.2, last]])))["relative"]
        for scale, last in ((2.0, 0.9), (1.0, 1.8))
    )
    assert alike < 1e-6
    assert math.isclose(other, 0.375 * math.log(2.0), rel_tol=1e-4)


def test_expected_errors_are_in_degrees(network):
    chord = torch.tensor([[2.0 * math.sin(math.radians(5.0)), 3.0]])
    lamps = torch.zeros(1, 2), torch.zeros(1, 2, 3, 3)
    lights = network.read_lights(SetPrediction(torch.zeros(1, 2, 3), torch.ones(1, 2), chord, *lamps))
    np.testing.assert_allclose(lights.expected_error, [[10.0, 180.0]], rtol=1e-5)


def test_options_that_build_nothing_are_refused():
    with pytest.raises(InputError, match="heads must divide width"):
        LightSetNet(width=30, heads=4)


def test_breadth_widens_the_convolutions() -> None:
    broad, usual = (LightSetNet(width=32, blocks=1, heads=2, breadth=breadth) for breadth in (1.34, 1.0))
    assert [level.more.out_channels for level in broad.levels] == [64, 128, 176, 256]
    assert [level.more.out_channels for level in usual.levels] == [48, 96, 128, 192]
    with torch.no_grad():
        assert broad(*scene()).directions.shape == (1, 5, 3)
    with pytest.raises(InputError, match="breadth must be above 0"):
        LightSetNet(breadth=0.0)
