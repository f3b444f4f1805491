"""The network with attention across lights, and the losses that come with it."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional

from render.shared.config import build, to_plain
from render.shared.errors import InputError
from sdps.core.losses import normal_gradient_loss, shading_loss
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch
from sdps.models import attention
from sdps.models.attention import AttentionNet
from sdps.models.base import DIVISIONS, Lights, Observations
from sdps.models.blocks import parameter_count
from sdps.models.checkpoint import TrainedModel, load_weights, save_weights
from sdps.models.registry import MODELS
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.training_config import JointTraining


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def observations(count: int, height: int = 12, width: int = 20) -> Observations:
    directions = functional.normalize(torch.rand(1, count, 3) + 0.1, dim=-1)
    return Observations(torch.rand(1, count, 3, height, width), directions)


def test_the_order_of_lights_does_not_matter_and_their_number_is_free() -> None:
    network, seen = AttentionNet().eval(), observations(5)
    order = torch.tensor([4, 2, 0, 3, 1])
    with torch.no_grad():
        whole = network(seen)
        turned = network(Observations(seen.images[:, order], seen.directions[:, order]))
        torch.testing.assert_close(turned, whole, atol=1e-5, rtol=1e-4)
        assert network(observations(1)).shape == (1, 3, 12, 20)
    torch.testing.assert_close(whole.norm(dim=1), torch.ones(1, 12, 20))


@pytest.mark.parametrize("blocks", [0, 2])
def test_only_attention_lets_lights_of_a_pixel_see_each_other(blocks: int) -> None:
    """And it stays within the pixel: a change far away in one image reaches no pixel of another."""
    network = AttentionNet(blocks=blocks).eval()
    tokens = torch.randn(1, 3, attention.WIDTH, 4, 4)
    changed = tokens.clone()
    changed[:, 2, :, 0, 0] = torch.randn(attention.WIDTH)  # no mere shift, which the normalisation takes away
    with torch.no_grad():
        difference = (network.mix(changed) - network.mix(tokens))[0, :2].abs().amax(dim=(0, 1))  # of the first two
    assert (float(difference[0, 0]) > 1e-3) is (blocks > 0)
    difference[0, 0] = 0.0
    assert float(difference.max()) < 1e-5


def test_features_kept_part_by_part_give_what_all_images_at_once_give(monkeypatch: pytest.MonkeyPatch) -> None:
    network, seen = AttentionNet().eval(), observations(5)
    with torch.no_grad():
        whole = network(seen)
        for strip in (1, 2**22):  # one row at a time, and all
            monkeypatch.setattr(attention, "_STRIP", strip)
            parts = [Observations(seen.images[:, some], seen.directions[:, some]) for some in (slice(2), slice(2, 5))]
            found = network.regress(network.fused([network.kept(part) for part in parts]))
            torch.testing.assert_close(found, whole, atol=2e-3, rtol=1e-2)  # float16 rounds at 0.0005


def test_a_divided_pixel_shows_no_albedo() -> None:
    images, mask = torch.rand(1, 4, 3, 8, 8) + 0.1, torch.ones(1, 1, 8, 8)
    albedo = torch.rand(1, 1, 1, 8, 8) + 0.5
    lights = Lights(torch.rand(1, 4, 3), torch.full((1, 4), 0.5))
    for division in DIVISIONS:
        network = AttentionNet(blocks=0, division=division)
        first, second = (network.observe(stack, mask, lights).images for stack in (images, images * albedo))
        assert torch.allclose(first, second, rtol=2e-3, atol=1e-4) is (division != "none")
    seen = AttentionNet(blocks=0).observe(images, mask, lights).images
    torch.testing.assert_close(seen.amax(dim=(1, 2)), torch.ones(1, 8, 8), rtol=1e-3, atol=1e-3)
    black = AttentionNet(blocks=0).observe(0.0 * images - 1e-6, mask, lights).images  # noise below the black level
    assert float(black.abs().max()) < 0.1


def test_mistaken_options_are_refused() -> None:
    with pytest.raises(InputError, match="did you mean 'max'"):
        AttentionNet(division="maxx")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="blocks must not be negative"):
        AttentionNet(blocks=-1)
    run = recipes.run("attention", {}, {"attention": {"options": {"bloks": 2}, "lights": "true"}})
    with pytest.raises(InputError, match="did you mean 'blocks'"):
        create_stage("attention", "attention", run.config, {})
    with pytest.raises(InputError, match="options must be empty"):
        build(JointTraining, {"options": {"blocks": 2}})


def batch(size: int = 16) -> Batch:
    normals = functional.normalize(torch.randn(2, 3, size, size), dim=1)
    directions = functional.normalize(torch.rand(2, 3, 3), dim=-1)
    mask = (torch.rand(2, 1, size, size) < 0.8).float()
    corner = torch.zeros(2, 2, dtype=torch.int64)
    images = torch.rand(2, 3, 3, size, size) * mask[:, None]
    return Batch(images, mask, normals * mask, directions, torch.ones(2, 3), corner, torch.arange(2))


def test_the_registered_model_trains_all_its_parameters() -> None:
    run = recipes.run("attention", {}, {"attention": {"lights": "true"}})
    assert recipes.run("attention", {}, {}).requires == {"lighting": "lcnet-soft"}
    stage = create_stage("attention", "attention", run.config, {})
    loss, terms = stage.loss(batch())
    loss.backward()
    assert terms.keys() == {"masked_loss", "gradient_loss", "shading_loss"}
    for name, parameter in stage.network.named_parameters():
        assert parameter.grad is not None and bool(torch.isfinite(parameter.grad).all()), name
        assert float(parameter.grad.abs().max()) > 0.0, name
    assert MODELS["attention"].parameters <= 3_000_000


def test_a_variant_goes_through_its_weights_file(tmp_path: Path) -> None:
    settings = {"base": "attention", "lights": "true", "options": {"blocks": 1, "division": "norm", "shading": False}}
    run = recipes.run("small", {}, {"small": settings})
    stage = create_stage("small", run.model, run.config, {})
    _, terms = stage.loss(batch())
    assert terms.keys() == {"masked_loss", "gradient_loss"}
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    (part,) = stage.parts(stage.network)
    save_weights(tmp_path / "own.safetensors", TrainedModel(part.model, part.network, part.options, metadata))
    loaded = load_weights(tmp_path / "own.safetensors", "normals")
    assert loaded.options == settings["options"]
    assert parameter_count(loaded.network) == parameter_count(stage.network) < MODELS["attention"].parameters
    seen = observations(3)
    with torch.no_grad():
        torch.testing.assert_close(loaded.network(seen), stage.network.eval()(seen))


def test_the_gradient_loss_knows_steps_and_not_offsets() -> None:
    truth = torch.zeros(1, 3, 4, 4)
    mask = torch.ones(1, 1, 4, 4)
    assert float(normal_gradient_loss(truth + 0.3, truth, mask)) == pytest.approx(0.0, abs=1e-6)
    ramp = truth.clone()
    ramp[:, 0] += 0.1 * torch.arange(4.0)  # one step of 0.1 along x, none along y
    assert float(normal_gradient_loss(ramp, truth, mask)) == pytest.approx(0.05)
    mask[..., 2:] = 0.0
    broken = ramp.clone()
    broken[..., 2:] = 7.0  # pairs across the border do not count
    kept = float(normal_gradient_loss(broken, truth, mask))
    assert kept == pytest.approx(4 * 0.1 / (4 + 6))
    assert float(normal_gradient_loss(broken, truth, 0.0 * mask)) == 0.0


def test_the_shading_loss_of_the_true_shading_is_zero() -> None:
    truth = torch.zeros(1, 3, 8, 8)
    truth[:, 2] = 1.0
    mask = torch.ones(1, 1, 8, 8)
    mask[..., :2] = 0.0
    directions = torch.tensor([[[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]])
    shading = torch.tensor([1.0, 0.8, 0.0])[None, :, None, None, None].expand(1, 3, 1, 2, 2)
    assert float(shading_loss(shading, truth, mask, directions)) == pytest.approx(0.0, abs=1e-10)
    off = shading + torch.tensor([0.1, 0.0, 0.0])[None, :, None, None, None]
    assert float(shading_loss(off, truth, mask, directions)) == pytest.approx(0.01 / 3, rel=1e-4)
    assert float(shading_loss(off, truth, 0.0 * mask, directions)) == 0.0
