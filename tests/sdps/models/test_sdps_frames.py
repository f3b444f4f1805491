"""The network that sees pixels in frames of their own, its first normals, and light errors in training."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_samples import distant_layout
from torch import Tensor
from torch.nn import functional

from render.shared.config import to_plain
from render.shared.errors import InputError
from sdps.core.first_normals import first_normals, frames, turn_to_sight
from sdps.core.symmetry import Symmetry
from sdps.data.augment import Augmentation
from sdps.models import blocks
from sdps.models.base import Lights, Observations, Placement
from sdps.models.blocks import Surroundings, parameter_count
from sdps.models.checkpoint import TrainedModel, load_weights, save_weights
from sdps.models.cnnps import rotate_about_view
from sdps.models.frames import FrameNet, FusedMap, Pixels, object_pixels, pixel_inputs
from sdps.models.registry import MODELS
from sdps.training import recipes
from sdps.training.stage_factory import create_stage
from sdps.training.stages import disturb


def unit(*shape: int) -> Tensor:
    """Return random unit vectors that look at the camera."""
    vectors = torch.randn(*shape, 3)
    vectors[..., 2] = vectors[..., 2].abs() + 0.5
    return functional.normalize(vectors, dim=-1)


def observations(images: int, side: int = 8) -> Observations:
    mask = torch.zeros(1, 1, side, side)
    mask[..., 1:-1, 2:] = 1.0
    return Observations(torch.rand(1, images, 3, side, side), unit(1, images), mask)


def aggregated(network: FrameNet, parts: list[Observations]) -> FusedMap:
    """Return the feature of images that come in parts."""
    so_far = None
    for part in parts:
        so_far = network.accumulate(so_far, part)
    return network.aggregate(so_far)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(7)


@pytest.fixture
def trained() -> FrameNet:
    """Return a network whose last layers are no longer zero."""
    network = FrameNet(width=16, blocks=2).eval()
    for last in (network.offset, network.leave[-1]):
        torch.nn.init.normal_(last.weight, std=0.1)
    return network


def test_a_lambertian_pixel_is_fitted_exactly_but_for_the_ridge():
    normals, lights = unit(50), unit(50, 20)
    colour = torch.rand(50, 3) + 0.1
    shading = torch.einsum("nqi,ni->nq", lights, normals).clamp(min=0.0)
    found, scale, error = first_normals(shading[..., None] * colour[:, None], lights)
    angles = torch.rad2deg((found * normals).sum(-1).clamp(-1.0, 1.0).acos())
    assert angles.mean() < 0.5
    torch.testing.assert_close(scale, colour, rtol=0.06, atol=0.02)
    assert error.max() < 0.03


def test_a_highlight_moves_the_first_normal_less_than_least_squares():
    normals, lights = unit(400), unit(400, 32)
    half = functional.normalize(lights + torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    shading = torch.einsum("nqi,ni->nq", lights, normals).clamp(min=0.0)
    gloss = 3.0 * torch.einsum("nqi,ni->nq", half, normals).clamp(min=0.0) ** 60 * (shading > 0)
    grey = 0.5 * shading + gloss
    plain = functional.normalize(torch.linalg.lstsq(lights, grey[..., None]).solution[..., 0], dim=-1)
    found, *_ = first_normals(grey[..., None].expand(-1, -1, 3), lights)
    errors = [(normals * each).sum(-1).clamp(-1.0, 1.0).acos().mean() for each in (found, plain)]
    assert errors[0] < 0.8 * errors[1]  # 0.6


@pytest.mark.parametrize("values", [0.0, -0.01])
def test_a_black_pixel_has_a_normal(values):
    found, scale, error = first_normals(torch.full((3, 5, 3), values), unit(3, 5))
    assert torch.isfinite(found).all() and (found[:, 2] > 0).all()
    assert (scale == 0).all() and torch.isfinite(error).all()


def test_a_frame_has_the_normal_along_z_and_the_view_in_its_xz_plane():
    normals = torch.cat([unit(30), torch.tensor([[0.0, 0.0, 1.0], [1e-5, 0.0, 1.0]])])
    axes = frames(functional.normalize(normals, dim=-1))
    torch.testing.assert_close(axes @ axes.transpose(1, 2), torch.eye(3).expand(len(axes), 3, 3), atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(len(axes)), atol=1e-4, rtol=0)
    view = axes[:30, :, 2]
    assert view[:, 1].abs().max() < 1e-5 and (view[:, 0] >= 0).all()


def test_what_a_pixel_is_told_does_not_change_when_it_turns_about_the_view():
    values, lights, errors, spread = torch.rand(20, 9, 3), unit(20, 9), torch.rand(20, 9), torch.zeros(20, 9, 6)
    turned = rotate_about_view(lights, 1.1)
    inputs = []
    for directions in (lights, turned):
        first, scale, error = first_normals(values, directions)
        axes = frames(first)
        start = (axes @ first[..., None])[..., 0]
        inputs.append(pixel_inputs(Pixels(values, directions, errors, spread), axes, start, scale, error))
    for one, other in zip(*inputs, strict=True):
        torch.testing.assert_close(one, other, atol=2e-3, rtol=1e-3)


def test_pixels_alone_turn_with_their_lights(trained):
    seen = observations(9)
    turned = seen._replace(directions=rotate_about_view(seen.directions, 0.7))
    with torch.no_grad():
        one, other = (trained.encode(each).normals.permute(0, 2, 3, 1)[seen.mask[:, 0] > 0] for each in (seen, turned))
    torch.testing.assert_close(rotate_about_view(one, 0.7), other, atol=5e-3, rtol=0)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_the_map_turns_with_the_scene(trained, turns):
    seen, symmetry = observations(9), Symmetry(turns, False)
    turned = Observations(symmetry.images(seen.images), symmetry.vectors(seen.directions), symmetry.images(seen.mask))
    with torch.no_grad():
        ours, theirs = trained.turn(trained.encode(seen), symmetry), trained.encode(turned)
        for one, other in zip(ours[:3], theirs[:3], strict=True):
            torch.testing.assert_close(one, other, atol=5e-3, rtol=0)


@pytest.fixture
def told() -> FrameNet:
    """Return a network that is told how far light spreads, and heeds it."""
    network = FrameNet(width=16, blocks=2, covariance=True).eval()
    for last in (network.offset, network.leave[-1], network.about):
        torch.nn.init.normal_(last.weight, std=0.1)
    return network


def spread_out(seen: Observations, axes: Tensor) -> Observations:
    """Return observations whose light spreads along axes (1, Q, 2, 3)."""
    return seen._replace(covariance=axes.transpose(-1, -2) @ axes)


@pytest.mark.parametrize("turns", [1, 2])
def test_light_that_spreads_turns_with_the_scene(told, turns):
    axes, symmetry, seen = 0.5 * torch.randn(1, 9, 2, 3), Symmetry(turns, False), observations(9)
    turned = Observations(symmetry.images(seen.images), symmetry.vectors(seen.directions), symmetry.images(seen.mask))
    with torch.no_grad():
        ours = told.turn(told.encode(spread_out(seen, axes)), symmetry)
        theirs, without = told.encode(spread_out(turned, symmetry.vectors(axes))), told.encode(turned)
    torch.testing.assert_close(ours.feature, theirs.feature, atol=5e-3, rtol=0)
    assert (theirs.feature - without.feature).abs().max() > 0.05, "it makes a difference"


def test_light_that_spreads_is_seen_along_the_line_of_sight(told):
    """A pixel before a pinhole is one before an orthographic camera, turned with its line of sight."""
    axes, seen = 0.5 * torch.randn(1, 9, 2, 3), observations(9)
    tilt = torch.tensor([0.3, -0.2, 1.0])
    turn = turn_to_sight(tilt)
    flat = spread_out(seen._replace(directions=seen.directions @ turn.T), axes @ turn.T)
    whole = tilt[None, :, None, None].expand(1, 3, *seen.mask.shape[-2:])
    tilted = spread_out(seen, axes)._replace(placement=Placement(torch.zeros_like(whole), whole))
    with torch.no_grad():
        ours, theirs = told.encode(flat), told.encode(tilted)
        names = "images", "directions", "covariance"
        parts = [tilted._replace(**{name: getattr(tilted, name)[:, some] for name in names})
                 for some in (slice(4), slice(4, 9))]  # fmt: skip
        in_parts = aggregated(told, parts)
    torch.testing.assert_close(ours.feature, theirs.feature, atol=1e-3, rtol=0)
    inside = seen.mask[0, 0] > 0.5
    torch.testing.assert_close(in_parts.feature[..., inside], theirs.feature[..., inside], atol=0.02, rtol=0)


def test_layers_before_the_fusion_learn_from_every_third_diagonal_and_see_all(trained):
    seen, some = observations(9), FrameNet(width=16, blocks=2, learn_every=3).eval()
    some.load_state_dict(trained.state_dict())
    ours, all_of_it = some.encode(seen), trained.encode(seen)
    torch.testing.assert_close(ours.feature, all_of_it.feature, atol=1e-5, rtol=0)
    rows, columns = torch.arange(8)[:, None], torch.arange(8)
    weights = torch.randn(8, 8) * seen.mask[0, 0]
    learned = weights * ((rows + columns) % 3 == 0)
    (gradient,) = torch.autograd.grad((ours.feature * weights).sum(), some.seen.weight)
    (expected,) = torch.autograd.grad((all_of_it.feature * learned).sum(), trained.seen.weight)
    torch.testing.assert_close(gradient, expected, atol=1e-4, rtol=1e-3)
    with pytest.raises(InputError, match="learn_every must be at least 1, got 0"):
        FrameNet(learn_every=0)


def test_sizes_that_pixels_are_worked_on_in_recur(trained, monkeypatch):
    """On CPUs torch compiles new kernels for every new size; that was half the time of a training step on one scene."""
    sizes, alone = [], FrameNet._per_pixel

    def count(self: FrameNet, pixels: Pixels) -> torch.Tensor:
        sizes.append(len(pixels.values))
        return alone(self, pixels)

    monkeypatch.setattr(FrameNet, "_per_pixel", count)
    seen, some = observations(9), FrameNet(width=16, blocks=2, learn_every=3).eval()
    trained.encode(seen)
    some.encode(seen)
    assert sizes == [256, 256, 256]  # of some 50 pixels; some are learned from, the others seen
    monkeypatch.setattr("sdps.models.frames._STRIP", 64)
    sizes.clear()
    with torch.no_grad():
        trained.encode(seen)
    assert set(sizes) == {7} and len(sizes) > 1


def test_neither_order_nor_chunks_of_images_matter(trained, monkeypatch):
    monkeypatch.setattr("sdps.models.frames._STRIP", 64)
    seen, order = observations(9), torch.randperm(9)
    shuffled = seen._replace(images=seen.images[:, order], directions=seen.directions[:, order])
    parts = [seen._replace(images=seen.images[:, part], directions=seen.directions[:, part])
             for part in (slice(0, 4), slice(4, 9))]  # fmt: skip
    with torch.no_grad():
        whole = trained(seen)
        torch.testing.assert_close(trained(shuffled), whole, atol=1e-4, rtol=0)
        chunked = trained.regress(aggregated(trained, parts))
    torch.testing.assert_close(chunked, whole, atol=0.02, rtol=0)  # images are kept in 16 bits


def test_chunks_are_joined_under_bfloat16(trained):
    parts = [observations(count) for count in (4, 5)]
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found = trained.regress(aggregated(trained, parts))
    assert found.dtype == torch.float32 and found.isfinite().all()


def test_an_untrained_network_gives_the_first_normals():
    network, seen = FrameNet().eval(), observations(12)
    inside, pixels = object_pixels(seen)
    with torch.no_grad():
        found = network(seen).permute(0, 2, 3, 1)[inside]
    torch.testing.assert_close(found, first_normals(pixels.values, pixels.directions)[0], atol=1e-4, rtol=0)


def test_a_mask_without_pixels_gives_a_map(trained):
    seen = observations(5)
    empty = seen._replace(mask=torch.zeros_like(seen.mask))
    with torch.no_grad():
        assert torch.isfinite(trained(empty)).all()


def test_attention_begins_as_nothing_and_is_the_same_in_training_and_in_use(trained):
    attending = FrameNet(width=16, blocks=2, heads=4).eval()
    missing = attending.load_state_dict(trained.state_dict(), strict=False).missing_keys
    assert missing and all(key.partition(".")[0] in FrameNet.added for key in missing)
    seen = observations(9)
    with torch.no_grad():
        torch.testing.assert_close(attending(seen), trained(seen))
    for layer in attending.attend:
        torch.nn.init.normal_(layer.answer.weight, std=0.1)
    order = torch.randperm(9)
    shuffled = seen._replace(images=seen.images[:, order], directions=seen.directions[:, order])
    with torch.no_grad():
        used, other = attending(seen), attending(shuffled)
    torch.testing.assert_close(attending(seen).detach(), used, atol=1e-4, rtol=0)
    torch.testing.assert_close(other, used, atol=1e-4, rtol=0)
    assert (used - trained(seen)).abs().max() > 1e-3


def test_surroundings_begin_as_nothing_and_reach_further(trained):
    wide = FrameNet(width=16, blocks=2, context=16).eval()
    missing = wide.load_state_dict(trained.state_dict(), strict=False).missing_keys
    assert missing and all(key.partition(".")[0] in FrameNet.added for key in missing)
    seen = observations(5)
    assert wide.size_multiple == 8 and trained.size_multiple == 4
    with torch.no_grad():
        torch.testing.assert_close(wide(seen), trained(seen))
    for parameter in wide.surroundings.leave.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    with torch.no_grad():
        used = wide(seen)
    torch.testing.assert_close(wide(seen).detach(), used, atol=1e-4, rtol=0)
    assert (used - trained(seen)).abs().max() > 1e-3


def test_nearer_pixels_count_more(monkeypatch):
    torch.manual_seed(0)
    block = Surroundings(8, 16, 4, 1)
    torch.nn.init.zeros_(block.ask[0].weight)
    torch.nn.init.zeros_(block.ask[0].bias)
    block.ask[0].weight.data[32:] = torch.eye(16)  # heard is the mean of what pixels show, weighted by distance
    block.answer[0].weight.data = torch.eye(16)
    block.answer[0].bias.data.zero_()
    seen = torch.zeros(1, 16, 8, 8)
    seen[0, :, 0, 0] = torch.randn(16)
    learned = block.attend(seen, 0)[0]
    found = learned.norm(dim=0)
    assert found[0, 1] > found[0, 3] > found[0, 7] > 0.0
    monkeypatch.setattr(blocks, "_TOGETHER", 5)
    with torch.no_grad():
        torch.testing.assert_close(block.attend(seen, 0)[0], learned)


def test_size_and_options():
    assert parameter_count(FrameNet()) == MODELS["frames"].parameters <= 3_000_000
    for options in ({"width": 0}, {"blocks": 0}):
        with pytest.raises(InputError, match="must be at least 1"):
            FrameNet(**options)
    for options in ({"heads": 5}, {"heads": 4, "attending": 9}):
        with pytest.raises(InputError, match="heads must divide width"):
            FrameNet(**options)
    with pytest.raises(InputError, match="context must be a multiple of 4"):
        FrameNet(context=6)
    with pytest.raises(InputError, match="camera"):
        FrameNet(frame="camra")


def test_light_errors_are_those_of_the_seed_and_grow_with_the_limit():
    lights = Lights(unit(2, 40), torch.rand(2, 40) + 0.5)
    one, again, none = (disturb(lights, [3, 4], limit) for limit in (1.0, 1.0, 0.0))
    torch.testing.assert_close(one.directions, again.directions)
    torch.testing.assert_close(none.directions, lights.directions)
    torch.testing.assert_close(none.intensities, lights.intensities)
    many = [disturb(lights, [seed, seed + 1], 1.0) for seed in range(0, 200, 2)]
    angles = torch.stack([(each.directions * lights.directions).sum(-1).clamp(-1, 1).acos() for each in many])
    assert 4.0 < math.degrees(angles.mean()) < 9.0
    expected = torch.stack([each.expected_error for each in many])
    assert 0.8 < math.degrees(angles.mean()) / expected.mean() < 1.25
    assert all((each.intensities > 0).all() for each in many)


def test_training_lights_err_and_validation_lights_do_not():
    run = recipes.run("frames", {}, {})
    assert run.config.light_error == 1.0
    stage = create_stage("frames", "frames", run.config, {})
    batch = _batch()
    assert not torch.equal(stage.training_lights(batch).directions, batch.directions)
    assert torch.equal(stage.lights(batch).directions, batch.directions)
    loss, terms = stage.loss(batch)
    assert np.isfinite(float(loss)) and {"masked_loss", "pixel_loss", "expected_loss"} <= terms.keys()
    with torch.no_grad():
        scores = stage.metrics(batch)
    assert scores["direction_mae_drawn"] > 0.1 and scores["normal_mae_drawn"] != scores["normal_mae"]


def _batch():
    from sdps.data.dataset import Batch

    seen = observations(6, 16)
    return Batch(seen.images, seen.mask, unit(1, 16, 16).permute(0, 3, 1, 2) * seen.mask, seen.directions,
                 torch.ones(1, 6), torch.zeros(1, 2, dtype=torch.int64), torch.tensor([5]),
                 **distant_layout(seen.images))  # fmt: skip


def test_the_errors_of_lights_make_a_difference(trained):
    seen, errors = observations(9), torch.full((1, 9), 8.0)
    with torch.no_grad():
        exact, zero, doubtful = (
            trained(seen._replace(light_errors=each)) for each in (None, torch.zeros(1, 9), errors)
        )
        parts = [
            Observations(seen.images[:, some], seen.directions[:, some], seen.mask, errors[:, some])
            for some in (slice(4), slice(4, 9))
        ]
        joined = trained.regress(trained.aggregate(parts))
    torch.testing.assert_close(exact, zero)
    torch.testing.assert_close(joined, doubtful)
    assert (exact - doubtful).abs().max() > 1e-3


def test_a_variant_goes_through_its_weights_file(tmp_path: Path) -> None:
    run = recipes.run("small", {}, {"small": {"base": "frames", "options": {"width": 16, "blocks": 1}}})
    stage = create_stage("small", run.model, run.config, {})
    metadata = {"config": {"augmentation": to_plain(Augmentation())}}
    file = tmp_path / "own.safetensors"
    save_weights(file, TrainedModel(stage.model, stage.network, stage.options, metadata))
    loaded, seen = load_weights(file), observations(3)
    assert loaded.options == {"width": 16, "blocks": 1}
    assert parameter_count(loaded.network) < MODELS["frames"].parameters
    with torch.no_grad():
        torch.testing.assert_close(loaded.network(seen), stage.network.eval()(seen))


def test_a_mistaken_option_is_refused() -> None:
    run = recipes.run("frames", {}, {"frames": {"options": {"bloks": 2}}})
    with pytest.raises(InputError, match="did you mean 'blocks'"):
        create_stage("frames", "frames", run.config, {})


def test_near_lamps_and_lines_of_sight_are_seen_as_an_orthographic_camera_would(trained):
    """A pixel under a near lamp before a pinhole is one under its own distant lamp, turned with its line of sight."""
    seen = observations(9)
    side = seen.images.shape[-1]
    tilt = torch.tensor([0.3, -0.2, 1.0])
    turn = turn_to_sight(tilt)
    sights = tilt[None, :, None, None].expand(1, 3, side, side)
    place, nearness = torch.tensor([0.4, -0.3, 0.2]), torch.linspace(0.0, 0.4, 9)[None]
    places = place[None, :, None, None].expand(1, 3, side, side)
    off = seen.directions - nearness[..., None] * place
    own = functional.normalize(off @ turn.T, dim=-1)
    strength = 1.0 / off.square().sum(-1)  # (1, Q)
    flat = seen._replace(directions=own)
    near = seen._replace(
        images=seen.images * strength[..., None, None, None], nearness=nearness, placement=Placement(places, sights)
    )
    with torch.no_grad():
        expected, found = trained(flat), trained(near)
        chunks = [Observations(near.images[:, some], near.directions[:, some], near.mask, None, nearness[:, some],
                               near.placement) for some in (slice(4), slice(4, 9))]  # fmt: skip
        in_parts = trained.regress(aggregated(trained, chunks))
    inside = seen.mask[0, 0] > 0.5
    turned = torch.einsum("ji,bjhw->bihw", turn, expected)
    torch.testing.assert_close(found[:, :, inside], turned[:, :, inside], atol=2e-4, rtol=0)
    assert float((in_parts - found)[:, :, inside].abs().max()) < 0.02


@pytest.mark.parametrize("symmetry", [Symmetry(1, False), Symmetry(3, False)])
def test_lines_of_sight_turn_with_the_scene(trained, symmetry):
    seen = observations(6)
    side = seen.images.shape[-1]
    places, tilts = torch.randn(1, 3, side, side) * 0.3, torch.rand(1, 3, side, side) * 0.4 - 0.2
    tilts[:, 2] = 1.0
    near = seen._replace(nearness=torch.full((1, 6), 0.2), placement=Placement(places, tilts))
    turned = near._replace(
        images=symmetry.images(near.images), directions=symmetry.vectors(near.directions),
        mask=symmetry.images(near.mask),
        placement=Placement(*(symmetry.vectors(symmetry.images(part), dim=1) for part in near.placement)),
    )  # fmt: skip
    with torch.no_grad():
        ours = trained.turn(trained.encode(near), symmetry)
        theirs = trained.encode(turned)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, atol=2e-4, rtol=1e-3)


def test_near_lamps_are_seen_in_full_precision_under_autocast(trained):
    seen = observations(6)
    side = seen.images.shape[-1]
    tilts = torch.rand(1, 3, side, side) * 0.4 - 0.2
    tilts[:, 2] = 1.0
    near = seen._replace(nearness=torch.full((1, 6), 0.2), placement=Placement(torch.randn(1, 3, side, side), tilts))
    with torch.no_grad():
        exact = object_pixels(near)[1].directions
        with torch.autocast("cpu", torch.bfloat16):
            rounded, normals = object_pixels(near)[1].directions, trained(near)
    assert rounded.dtype == normals.dtype == torch.float32 and torch.equal(rounded, exact)
    inside = seen.mask[0, 0] > 0.5
    assert float((normals.norm(dim=1)[:, inside] - 1.0).abs().max()) < 1e-5
