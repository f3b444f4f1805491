"""The networks: sizes from the paper's tables, invariances, and what their losses mean."""

import pytest
import torch

from render.shared.errors import InputError
from sdps.core.losses import faithful_normal_loss, masked_normal_loss
from sdps.models.base import Lights, Observations
from sdps.models.blocks import conv, parameter_count
from sdps.models.lcnet import LCNet, LightingLogits, resize_input
from sdps.models.nenet import NENet
from sdps.models.registry import COMBINATIONS, MODELS, create
from sdps.models.upsfcn import UPSFCN


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize("name", MODELS)
def test_parameter_counts_of_the_registry(name: str) -> None:
    assert parameter_count(create(name)) == MODELS[name].parameters


def test_parameter_counts_of_the_paper() -> None:
    assert parameter_count(LCNet()) == 4_409_692
    assert parameter_count(NENet()) == 2_210_048
    # The ablations: without the mask channel, and without the global feature.
    assert parameter_count(LCNet(use_mask=False)) == 4_409_116
    assert parameter_count(LCNet(use_global=False)) == 3_819_868


def test_parameter_counts_of_the_parts() -> None:
    network = LCNet()
    assert parameter_count(network.extractor) == 1_404_224
    heads = sum(parameter_count(head) for head in (network.azimuth, network.elevation, network.intensity))
    assert parameter_count(network.classifier) + heads == 3_005_468


def test_weights_are_drawn_as_kaiming_normal_with_zero_biases() -> None:
    network = NENet()
    weight = network.extractor[4][0].weight  # 3x3, 256 -> 256
    assert float(weight.detach().std()) == pytest.approx((2.0 / (9 * 256)) ** 0.5, rel=0.02)
    assert float(network.extractor[4][0].bias.detach().abs().max()) == 0.0


def test_shapes_alone_draw_no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.nn.init, "kaiming_normal_", None)  # on this device it loads torch's compiler
    with torch.device("meta"):
        network = create("lcnet")
    assert all(parameter.is_meta for parameter in network.parameters())


def test_convolutions_leave_autocast_for_single_pixels_only() -> None:
    layer, plain = conv(4, 8), torch.nn.Conv2d(4, 8, 3, padding=1)
    assert layer[0].state_dict().keys() == plain.state_dict().keys()
    plain.load_state_dict(layer[0].state_dict())
    point, patch = torch.rand(2, 4, 1, 1), torch.rand(2, 4, 1, 2)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(point.bfloat16()).dtype == torch.float32
        assert layer(patch).dtype == conv(4, 8, kernel=1)(point).dtype == torch.bfloat16
    for features in (point, patch):
        torch.testing.assert_close(layer[0](features), plain(features))


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'lcnet'"):
        create("lcnett")
    with pytest.raises(InputError, match="use_mask"):
        create("lcnet", usemask=False)


def test_lcnet_follows_the_order_of_its_images() -> None:
    network = LCNet().eval()
    images, mask = torch.rand(1, 4, 3, 128, 128), torch.ones(1, 1, 128, 128)
    order = torch.tensor([2, 0, 3, 1])
    with torch.no_grad():
        straight, shuffled = network(images, mask), network(images[:, order], mask)
    for first, second in zip(straight, shuffled, strict=True):
        torch.testing.assert_close(first[:, order], second)


def test_lcnet_shares_information_between_images_only_through_the_global_feature() -> None:
    images, mask = torch.rand(1, 3, 3, 128, 128), torch.ones(1, 1, 128, 128)
    for use_global in (True, False):
        network = LCNet(use_global=use_global).eval()
        with torch.no_grad():
            difference = network(images, mask).azimuth[:, :2] - network(images[:, :2], mask).azimuth
        assert bool(difference.abs().max() > 1e-4) is use_global


def test_lcnet_may_be_trained_on_half_the_size_first() -> None:
    network = LCNet()
    prediction = network(torch.rand(1, 2, 3, 64, 64), torch.ones(1, 1, 64, 64))
    assert prediction.azimuth.shape == (1, 2, 36)
    network.loss(prediction, Lights(torch.tensor([[[0.0, 0.0, 1.0]] * 2]), torch.ones(1, 2)))["total"].backward()
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_nenet_ignores_the_order_of_its_images_and_takes_any_number_and_size() -> None:
    network = NENet().eval()
    images, directions = torch.rand(1, 5, 3, 20, 36), torch.rand(1, 5, 3)
    order = torch.tensor([4, 2, 0, 3, 1])
    with torch.no_grad():
        whole = network(Observations(images, directions))
        torch.testing.assert_close(network(Observations(images[:, order], directions[:, order])), whole)
        halves = [Observations(images[:, part], directions[:, part]) for part in (slice(2), slice(2, 5))]
        running = torch.maximum(*(network.encode(half) for half in halves))
        torch.testing.assert_close(network.regress(running), whole)
        assert network(Observations(images[:, :1], directions[:, :1])).shape == (1, 3, 20, 36)
    torch.testing.assert_close(whole.norm(dim=1), torch.ones(1, 20, 36))


def test_resizing_for_lcnet_keeps_means() -> None:
    images, mask = torch.rand(1, 2, 3, 320, 200), torch.ones(1, 1, 320, 200)
    small, small_mask = resize_input(images, mask)
    assert small.shape == (1, 2, 3, 128, 128)
    assert float(small.mean()) == pytest.approx(float(images.mean()), abs=2e-3)
    torch.testing.assert_close(small_mask, torch.ones(1, 1, 128, 128))


def test_lighting_loss_of_uniform_logits_is_the_log_of_the_class_counts() -> None:
    logits = LightingLogits(torch.zeros(2, 3, 36), torch.zeros(2, 3, 36), torch.zeros(2, 3, 20))
    loss = LCNet().loss(logits, Lights(torch.tensor([0.0, 0.0, 1.0]).expand(2, 3, 3), torch.ones(2, 3)))
    assert float(loss["azimuth"]) == pytest.approx(3.5835, abs=1e-4)  # ln 36
    assert float(loss["total"]) == pytest.approx(2 * 3.5835 + 2.9957, abs=1e-3)


def test_faithful_loss_is_the_masked_one_diluted_by_the_background() -> None:
    truth = torch.nn.functional.normalize(torch.randn(2, 3, 8, 8), dim=1)
    mask = (torch.rand(2, 1, 8, 8) < 0.4).float()
    mask[1] = mask[0]  # the loss weighs scenes, not pixels
    share = float(mask.mean())
    normals = [torch.nn.functional.normalize(torch.randn(2, 3, 8, 8), dim=1).requires_grad_() for _ in range(2)]
    normals[1].data.copy_(normals[0].data)
    faithful = faithful_normal_loss(normals[0], truth * mask)
    masked = masked_normal_loss(normals[1], truth * mask, mask)
    assert float(faithful.detach()) == pytest.approx(share * float(masked.detach()) + (1.0 - share), abs=1e-6)
    faithful.backward()
    masked.backward()
    torch.testing.assert_close(normals[0].grad, share * normals[1].grad)


def test_faithful_loss_is_torchs_cosine_embedding_loss() -> None:
    normals = torch.nn.functional.normalize(torch.randn(1, 3, 6, 6), dim=1)
    truth = torch.nn.functional.normalize(torch.randn(1, 3, 6, 6), dim=1) * (torch.rand(1, 1, 6, 6) < 0.5)
    flat = [tensor.permute(0, 2, 3, 1).reshape(-1, 3) for tensor in (normals, truth)]
    reference = torch.nn.CosineEmbeddingLoss()(*flat, torch.ones(36))
    assert float(faithful_normal_loss(normals, truth)) == pytest.approx(float(reference), abs=1e-5)


def test_published_counts_are_met_within_two_per_cent() -> None:
    published = {  # the paper's table "Normal estimation", in millions
        "psfcn": 2.2, "upsfcn-deep-mask": 6.1, "upsfcn-deep": 6.1, "upsfcn-wide": 6.4, "upsfcn-light": 5.7,
        "upsfcn": 2.2,
    }  # fmt: skip
    for name, millions in published.items():
        assert MODELS[name].parameters == pytest.approx(millions * 1e6, rel=0.02), name
    for name in ("sdps", "sdps-reg"):
        assert COMBINATIONS[name].parameters() == pytest.approx(6.6e6, rel=0.02)
    assert all(pair.parameters() <= 10_000_000 for pair in COMBINATIONS.values())


def test_reconstructions_say_so() -> None:
    for name in ("lcnet-reg", "upsfcn-wide", "upsfcn-deep", "upsfcn-deep-mask", "upsfcn-light"):
        assert MODELS[name].reconstruction, name
        assert "reconstruction" in (MODELS[name].build.__doc__ or "")


def test_the_masked_loss_of_parts_averages_to_that_of_the_whole() -> None:
    truth = torch.nn.functional.normalize(torch.randn(4, 3, 8, 8), dim=1)
    normals = torch.nn.functional.normalize(torch.randn(4, 3, 8, 8), dim=1)
    mask = (torch.rand(4, 1, 8, 8) < torch.tensor([0.1, 0.9, 0.5, 0.0])[:, None, None, None]).float()
    parts = [masked_normal_loss(normals[part], truth[part], mask[part]) for part in (slice(2), slice(2, 4))]
    torch.testing.assert_close(torch.stack(parts).mean(), masked_normal_loss(normals, truth, mask))


def test_per_pixel_networks_see_shading_without_albedo() -> None:
    network = NENet(per_pixel=True)
    images, mask = torch.rand(1, 4, 3, 8, 8) + 0.1, torch.ones(1, 1, 8, 8)
    lights = Lights(torch.rand(1, 4, 3), torch.ones(1, 4))
    albedo = torch.rand(1, 1, 1, 8, 8) + 0.5
    first, second = (network.observe(stack, mask, lights).images for stack in (images, images * albedo))
    torch.testing.assert_close(first, second, rtol=1e-3, atol=1e-4)
    # The published norm is that of 32 images, whatever their number here.
    twice = network.observe(images.repeat(1, 2, 1, 1, 1), mask, Lights(torch.rand(1, 8, 3), torch.ones(1, 8))).images
    torch.testing.assert_close(twice[:, :4], first)
    thirty_two = torch.rand(1, 32, 3, 4, 4)
    norm = thirty_two.square().sum((1, 2), keepdim=True).sqrt()
    seen = network.observe(thirty_two, torch.ones(1, 1, 4, 4), Lights(torch.rand(1, 32, 3), torch.ones(1, 32)))
    torch.testing.assert_close(seen.images, thirty_two / norm, rtol=1e-3, atol=1e-5)


def test_a_network_sees_only_what_it_declares() -> None:
    images, mask = torch.rand(1, 2, 3, 8, 8), torch.ones(1, 1, 8, 8)
    lights = Lights(torch.rand(1, 2, 3), torch.full((1, 2), 0.5))
    seen = NENet().observe(images, mask, lights)
    torch.testing.assert_close(seen.images, images * 2.0)
    assert seen.directions is lights.directions and seen.mask is None
    alone = UPSFCN(use_mask=True).observe(images, mask, None)
    assert alone.images is images and alone.directions is None and alone.mask is mask
