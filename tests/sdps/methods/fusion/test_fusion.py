"""Joining what a network and refinement found: at first the plain mean; in tiles as in one piece."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from render.shared.errors import InputError
from sdps.api import make_runner
from sdps.core.estimate import Estimate
from sdps.core.geometry import Rig
from sdps.core.metrics import angle_degrees
from sdps.core.symmetry import SYMMETRIES, Symmetry
from sdps.methods.fusion import fuse as fusing
from sdps.methods.fusion.evidence import Evidence, find_place
from sdps.methods.fusion.network import REACH, FusionNet, describe, prepare, prepare_part
from sdps.methods.parse import parse
from sdps.methods.pretrained import require
from sdps.methods.runner import Runner
from sdps.refinement.image_model import Refined
from sdps.refinement.problems import FEWEST
from sdps.refinement.refine import RefineConfig, refine
from sdps.refinement.trust import RefinedEstimate


def sphere(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (height, width, 3) and mask of an ellipsoid that fills the picture."""
    y, x = np.mgrid[1 : -1 : height * 1j, -1 : 1 : width * 1j]
    mask = x**2 + y**2 < 0.9
    normals = np.stack([x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], axis=-1)
    return (normals * mask[..., None]).astype(np.float32), mask


def bumpy(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    moved = normals + 0.1 * rng.normal(size=normals.shape) * normals.any(axis=-1, keepdims=True)
    return (moved / np.maximum(np.linalg.norm(moved, axis=-1, keepdims=True), 1e-9)).astype(np.float32)


def make_evidence(height: int = 24, width: int = 32) -> Evidence:
    normals, mask = sphere(height, width)
    rng = np.random.default_rng(3)

    def drawn(most: float) -> np.ndarray:
        return (rng.uniform(0.01, most, mask.shape) * mask).astype(np.float32)

    return Evidence(
        mask=mask, network=bumpy(normals, rng), refined=bumpy(normals, rng), start=bumpy(normals, rng),
        told=drawn(9.0), told_first=drawn(9.0), expected=drawn(9.0), residual=drawn(0.1), albedo=drawn(2.0),
        gloss=drawn(1.0), used=drawn(1.0), images=20.0, spread=0.5, nearness=0.1, turned=2.0, lit=0.0,
    )  # fmt: skip


def drawn_network() -> FusionNet:
    """Return a network whose answer depends on all it sees."""
    torch.manual_seed(0)
    network = FusionNet(width=8).eval()
    for parameter in network.out[-1].parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network


def test_an_untrained_network_answers_the_plain_mean() -> None:
    evidence = make_evidence()
    normals, expected = fusing.join(evidence, FusionNet().eval())
    mean = evidence.network + evidence.refined
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-9)
    assert np.allclose(normals, mean, atol=1e-5)
    assert not normals[~evidence.mask].any() and not expected[~evidence.mask].any()
    assert (expected[evidence.mask] > 0.0).all()


def test_tiles_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence, network = make_evidence(480, 40), drawn_network()
    whole, told = fusing.join(evidence, network)
    monkeypatch.setattr(fusing, "TILE_PIXELS", (2 * REACH + 64) * 40)
    cut, said = fusing.join(evidence, network)
    assert np.allclose(cut, whole, atol=1e-5) and np.allclose(said, told, rtol=1e-4)


@pytest.mark.parametrize("symmetry", SYMMETRIES[1:], ids=str)
def test_inputs_of_a_turned_object_are_the_turned_inputs(symmetry: Symmetry) -> None:
    evidence = make_evidence(32, 32)
    vectors = {"network", "refined", "start"}

    def turned(name: str, each: np.ndarray) -> np.ndarray:
        if each.ndim < 2:
            return each
        images = np.ascontiguousarray(symmetry.images(each, 0))
        return np.ascontiguousarray(symmetry.vectors(images)) if name in vectors else images

    other = Evidence(**{name: turned(name, each) for name, each in evidence.arrays().items()})
    for one, two in zip(prepare(evidence).turn(symmetry), prepare(other), strict=True):
        assert torch.allclose(one, two, atol=1e-5)


def test_the_whole_object_describes_every_part() -> None:
    evidence = make_evidence()
    part = prepare_part(evidence.part(slice(0, 8), slice(8, 24)), describe(evidence))
    assert torch.equal(part.numbers, describe(evidence))
    assert torch.equal(part.maps, prepare(evidence).maps[:, :, :8, 8:24])
    worse = replace(evidence, residual=2.0 * evidence.residual)
    assert describe(worse)[0, 0] > describe(evidence)[0, 0]


def test_the_box_has_room_inside_the_picture() -> None:
    mask = np.zeros((20, 30), bool)
    mask[1:3, 10:12] = True
    assert find_place(mask) == (slice(0, 7), slice(6, 16))


def test_fused_methods_are_asked_for_by_name() -> None:
    method = parse("sdps-frames+fuse", require)
    assert method.fused and method.refined and method.name.endswith(", fused")
    for text, said in (
        ("lcnet+psfcn+fuse", "tells its errors"),
        ("pf14+fuse", "tells its errors"),
        ("fuse", "say what"),
    ):
        with pytest.raises(InputError, match=said):
            parse(text, require)
    assert make_runner("auto", (False, False), None, None, None, images=FEWEST).method.fused
    assert not make_runner("auto", (False, False), None, None, None, images=FEWEST - 1).method.refined
    assert not make_runner("sdps-frames+refine", (False, False), None, None, None, images=40).method.fused
    assert not make_runner("lcnet+psfcn", (False, False), None, None, None, images=40).method.fused


def photographs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images (12, 40, 40, 3) of a matte ball, its mask and its lights (12, 3)."""
    normals, mask = sphere(40, 40)
    turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    lights = np.stack([0.6 * np.cos(turns), 0.6 * np.sin(turns), np.full(12, 0.8)], axis=1).astype(np.float32)
    images = np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0)[..., None].repeat(3, axis=-1)
    return images.astype(np.float32), mask, lights


def test_lights_that_went_astray_leave_the_networks_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    images, mask, _ = photographs()

    def stray(*given: Any, **more: Any) -> Refined:
        found = refine(*given, **more)
        return replace(found, light_directions=found.light_directions[:, [1, 2, 0]])

    monkeypatch.setattr("sdps.refinement.refine.refine", stray)
    quick = RefineConfig(coarse_pixels=400, iterations=2, iterations_before=1, fine_iterations=1)
    runner = Runner(parse("sdps-frames+fuse", require), require, refining=quick)
    found = runner.estimate(images, mask, None, None)
    assert isinstance(found, RefinedEstimate) and not isinstance(found, fusing.FusedEstimate)
    assert found.normals is found.start.normals and found.light_directions is found.start.light_directions
    assert "turned the lights" in found.trust.doubt


@pytest.mark.parametrize("lit", [False, True], ids=["nothing given", "lights given"])
def test_the_fused_answer_lies_between_both_witnesses(lit: bool) -> None:
    images, mask, lights = photographs()
    quick = RefineConfig(coarse_pixels=400, iterations=20, iterations_before=10, fine_iterations=5)
    runner = Runner(parse("frames+fuse" if lit else "sdps-frames+fuse", require), require, refining=quick)
    given = (lights, np.ones(12, np.float32)) if lit else (None, None)
    found = runner.estimate(images, mask, given[0], given[1], rig=Rig())
    assert isinstance(found, fusing.FusedEstimate) and isinstance(found.start, Estimate)
    box, evidence = find_place(mask), runner.ask_again(images, mask, found, lit=lit)
    apart = angle_degrees(evidence.network, evidence.refined)[evidence.mask].mean()
    witnesses = (evidence.network, evidence.refined)
    away = [angle_degrees(found.normals[box], each)[evidence.mask].mean() for each in witnesses]
    assert found.moved == pytest.approx(away, abs=0.01)
    assert max(away) < apart + 5.0 and evidence.lit == float(lit)
    assert found.expected_error is not None and found.expected_error[mask].min() > 0.0
    assert np.allclose(np.linalg.norm(found.normals[mask], axis=-1), 1.0, atol=1e-4)
    np.testing.assert_array_equal(found.light_directions, found.refined.light_directions)
    assert not found.trust.doubt
    plain = Runner(replace(runner.method, fused=False), require, refining=quick)
    assert plain.identity() != runner.identity()
