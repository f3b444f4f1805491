"""What fusion learns from is kept as it was, and the network learns whom to believe."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sdps_scenes import write_data

from lab.releases import fusion
from lab.releases.fusion_data import Photographs
from lab.shared.answered_scenes import Answered, keep, measure, read, read_all, tabulate
from render.shared.errors import InputError
from sdps.core.estimate import Estimate
from sdps.core.metrics import angle_degrees
from sdps.methods.fusion.evidence import Evidence, find_place
from sdps.methods.fusion.network import FusionNet, prepare
from sdps.refinement.trust import RefinedEstimate


def ball(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (side, side, 3) and mask of a ball."""
    y, x = np.mgrid[1 : -1 : side * 1j, -1 : 1 : side * 1j]
    mask = x**2 + y**2 < 0.8
    normals = np.stack([x, y, np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))], axis=-1)
    return (normals * mask[..., None]).astype(np.float32), mask


def answered(seed: int, held_out: bool = False, off_by: float = 0.2) -> Answered:
    """Return a ball of which the network knows the truth, and refinement something else that it believes itself."""
    rng, (normals, mask) = np.random.default_rng(seed), ball(24)
    off = normals + mask[..., None] * rng.normal(0.0, off_by, 3)
    wrong = (off / np.maximum(np.linalg.norm(off, axis=-1, keepdims=True), 1e-9)).astype(np.float32)
    flat = {name: np.where(mask, value, 0.0).astype(np.float32) for name, value in
            {"told": 2.0, "told_first": 3.0, "expected": 3.0, "residual": 0.05, "albedo": 1.0, "gloss": 1.0,
             "used": 0.9}.items()}  # fmt: skip
    evidence = Evidence(
        mask=mask, network=normals, refined=wrong, start=normals, images=32.0, spread=0.5, nearness=0.0, turned=2.0,
        lit=0.0, **flat,
    )  # fmt: skip
    return Answered(
        name=str(seed), evidence=evidence, truth=normals, held_out=held_out, lights=(3.0, 2.0), start=normals,
        told=flat["told_first"], images=32, lit=False,
    )  # fmt: skip


def found(scene: Answered, lights: np.ndarray, start: np.ndarray) -> RefinedEstimate:
    """Return what keeps of a scene need: its answer is the start, normals (h, w, 3) under lights (L, 3)."""
    begun = Estimate(start, lights, np.ones(len(lights), np.float32), expected_error=scene.told)
    return RefinedEstimate(**vars(begun), refined=begun, start=begun, trust=None)  # type: ignore[arg-type]


def test_fusion_learns_whom_to_believe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "_SIDE", 24)
    monkeypatch.setattr(fusion, "_RATE", 3e-3)
    scenes = [answered(seed) for seed in range(6)]
    other = answered(9, held_out=True)
    before, after = (measure(other, net) for net in (FusionNet().eval(), fusion.train(scenes, 60, 16, 0)))
    assert before[4] == pytest.approx(before[3], abs=0.1)  # the plain mean
    assert after[4] < 0.5 * before[4]
    assert list(fusion.group([*scenes, other]))[:2] == ["learned from", "held out"]
    assert "held out" in "".join(tabulate(fusion.group([*scenes, other]), FusionNet().eval()))


def test_an_easy_scene_counts_about_as_much_as_a_hard_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "_EXPECTED", 0.0)
    losses, errors = [], []
    for off_by in (0.05, 1.6):
        scene = answered(3, off_by=off_by)
        losses.append(float(fusion._loss(FusionNet().eval(), prepare(scene.evidence), fusion._truth(scene))))
        errors.append(measure(scene, FusionNet().eval())[3])  # of the plain mean, which it begins as
    assert errors[1] > 4.0 * errors[0]
    assert losses[0] < losses[1] < 1.6 * losses[0]


UP = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1))


def test_an_answered_scene_is_read_back(tmp_path: Path) -> None:
    scene = answered(3)
    mask, box = scene.evidence.mask, find_place(scene.evidence.mask)
    answer = found(scene, UP, scene.truth), scene.evidence.part(*box)
    keep(tmp_path / "a.npz", answer, scene.truth, UP, held_out=True, lit=False)
    (back,) = read_all(tmp_path)
    assert back.held_out and not back.lit and back.name == "a" and back.images == 32
    assert back.lights == pytest.approx((0.0, 0.0), abs=0.1)
    np.testing.assert_array_equal(back.evidence.mask, mask[box])
    np.testing.assert_allclose(back.truth, scene.truth[box], atol=1e-3)
    np.testing.assert_allclose(back.evidence.refined, scene.evidence.refined[box], atol=1e-3)
    assert back.evidence.numbers == scene.evidence.numbers


def test_a_scene_without_evidence_stays_in_the_table_as_the_networks_answer(tmp_path: Path) -> None:
    scene = answered(3)
    answer = found(scene, UP, scene.evidence.refined), None  # the network is wrong here
    keep(tmp_path / "a.npz", answer, scene.truth, UP, held_out=True, lit=False)
    (back,) = read_all(tmp_path)
    network = FusionNet().eval()
    off = float(angle_degrees(scene.evidence.refined, scene.truth)[scene.evidence.mask].mean())
    assert back.evidence is None and off > 1.0
    assert measure(back, network) == pytest.approx([off] * 5 + [3.0], abs=0.05)
    table = "".join(tabulate({"all": [back, scene]}, network)).splitlines()
    (line,) = [each.split() for each in table if "all" in each]
    assert line[1] == "2"
    assert float(line[2]) == pytest.approx(off / 2, abs=0.05)  # the other scene's first look is the truth
    assert list(fusion.group([back]))[-1].startswith("held out, 32") and fusion.group([back])["held out"] == [back]


def test_a_scene_without_evidence_teaches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "_SIDE", 24)
    scenes = [answered(seed) for seed in range(2)]
    alone, beside = (fusion.train(some, 2, 8, 0) for some in (scenes, [*scenes, replace(answered(7), evidence=None)]))
    for one, two in zip(alone.parameters(), beside.parameters(), strict=True):
        assert torch.equal(one, two)


def test_a_file_without_an_answer_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", held_out=np.asarray(True))
    with pytest.raises(InputError, match=r"a\.npz: holds no answer.*delete it"):
        read(tmp_path / "a.npz")


def test_what_half_floats_do_not_hold_is_kept_as_their_largest(tmp_path: Path) -> None:
    scene = answered(3)
    glossy = replace(scene.evidence, gloss=scene.evidence.gloss * np.float32(1e6))
    answer = found(scene, UP, scene.truth), glossy.part(*find_place(glossy.mask))
    keep(tmp_path / "a.npz", answer, scene.truth, UP, held_out=True, lit=False)
    (back,) = read_all(tmp_path)
    assert np.isfinite(back.evidence.gloss).all() and back.evidence.gloss.max() == 65504.0


def test_an_answer_that_is_not_finite_stops_the_training_and_the_step_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "_SIDE", 24)
    monkeypatch.setattr(fusion, "_BATCH", 1)
    scene = answered(1)
    broken = replace(scene, evidence=replace(scene.evidence, gloss=scene.evidence.gloss * np.float32(np.inf)))
    last = int(np.random.default_rng(0).permutation(3)[-1])
    with pytest.raises(ArithmeticError, match="at step 2; an answer is not finite"):
        fusion.train([broken if number == last else scene for number in range(3)], 1, 16, 0)


def test_photographs_are_those_of_cameras_that_expose_as_people_do(tmp_path: Path) -> None:
    scenes = write_data(tmp_path, ("train",) * 12, lights=24, size=32)
    levels = []
    for scene in scenes:
        shown = Photographs(tmp_path, scene)
        assert 4 <= len(shown.images) == len(shown.gains) == len(shown.placed.directions) <= 24
        assert shown.images.max() <= 1.0 and shown.images.min() > -0.2
        levels.append(float(shown.images[:, shown.mask].mean()))
        lit = np.einsum("hwc,lc->lhw", shown.normals, shown.placed.directions).clip(0.0) * shown.gains[:, None, None]
        assert np.corrcoef(lit[:, shown.mask].ravel(), shown.images[:, shown.mask].mean(-1).ravel())[0, 1] > 0.8
    assert min(levels) < 0.08 and max(levels) > 0.3
