"""The networks: sizes from the paper's tables, invariances, and what their losses mean."""

import pytest
import torch

from render.errors import InputError
from sdps.losses import faithful_normal_loss, lighting_loss, masked_normal_loss
from sdps.models.blocks import parameter_count
from sdps.models.lcnet import LCNet, LightingLogits, resize_input
from sdps.models.nenet import NENet
from sdps.models.registry import MODELS, create


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


def test_nenet_ignores_the_order_of_its_images_and_takes_any_number_and_size() -> None:
    network = NENet().eval()
    images, directions = torch.rand(1, 5, 3, 20, 36), torch.rand(1, 5, 3)
    order = torch.tensor([4, 2, 0, 3, 1])
    with torch.no_grad():
        whole = network(images, directions)
        torch.testing.assert_close(network(images[:, order], directions[:, order]), whole)
        running = torch.maximum(
            network.encode(images[:, :2], directions[:, :2]), network.encode(images[:, 2:], directions[:, 2:])
        )
        torch.testing.assert_close(network.regress(running), whole)
        assert network(images[:, :1], directions[:, :1]).shape == (1, 3, 20, 36)
    torch.testing.assert_close(whole.norm(dim=1), torch.ones(1, 20, 36))


def test_resizing_for_lcnet_keeps_means() -> None:
    images, mask = torch.rand(1, 2, 3, 320, 200), torch.ones(1, 1, 320, 200)
    small, small_mask = resize_input(images, mask)
    assert small.shape == (1, 2, 3, 128, 128)
    assert float(small.mean()) == pytest.approx(float(images.mean()), abs=2e-3)
    torch.testing.assert_close(small_mask, torch.ones(1, 1, 128, 128))


def test_lighting_loss_of_uniform_logits_is_the_log_of_the_class_counts() -> None:
    logits = LightingLogits(torch.zeros(2, 3, 36), torch.zeros(2, 3, 36), torch.zeros(2, 3, 20))
    classes = tuple(torch.zeros(2, 3, dtype=torch.int64) for _ in range(3))
    loss = lighting_loss(logits, classes)
    assert float(loss.azimuth) == pytest.approx(3.5835, abs=1e-4)  # ln 36
    assert float(loss.total) == pytest.approx(2 * 3.5835 + 2.9957, abs=1e-3)


def test_faithful_loss_is_the_masked_one_diluted_by_the_background() -> None:
    truth = torch.nn.functional.normalize(torch.randn(2, 3, 8, 8), dim=1)
    mask = (torch.rand(2, 1, 8, 8) < 0.4).float()
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
