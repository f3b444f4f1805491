"""Static scenes of glossy objects raise no alarm, and the same scenes spoilt do."""

import json
from pathlib import Path

import classical_scenes as scenes
import numpy as np
import photo_folders as folders
import pytest
from sdps_scenes import write_data

from lab.bench import bench_checks
from lab.commands import main
from pipelines.evaluate.self_test import photograph_bunny
from sdps import photos
from sdps.photos.analysis.colours import colour_casts
from sdps.photos.checks import Finding

BODIES = {"red": (0.5, 0.05, 0.05), "black": (0.015, 0.015, 0.015), "blue": (0.05, 0.1, 0.4)}
STEP = (5, -4)  # pixels


def glossy(shape: str, body: str, roughness: float = 0.15, count: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Return exposed images (L, S, S, 3) with noise, and the mask, of coloured plastic with a white gloss."""
    normals, mask = getattr(scenes, shape)(96)
    lights, gains = scenes.lights(count, 3), np.random.default_rng(1).uniform(0.3, 2.0, count)
    matte = scenes.glossy(normals, mask, lights, diffuse=1.0, specular=0.0, intensities=gains).images
    gloss = scenes.glossy(
        normals, mask, lights, diffuse=0.0, specular=0.15, roughness=roughness, intensities=gains
    ).images
    images = matte * BODIES[body] + gloss
    images = np.pad(images / np.percentile(images[:, mask], 99.5), ((0, 0), (20, 20), (20, 20), (0, 0)))
    noise = np.random.default_rng(2).normal(0, 0.002, images.shape)
    return np.clip(images + 0.003 + noise, 0, 1).astype(np.float32), np.pad(mask, 20)


def alarms(folder: Path, images: np.ndarray, mask: np.ndarray) -> dict[str, Finding]:
    """Return the findings about movement, colour and duplicates, by a word of theirs."""
    found = photos.check(photos.load(folders.write_folder(folder, images, mask)))
    found = [finding for finding in found if finding.level != "note"]
    words = ("moved", "edges lie in different", "colour changes", "twice")
    return {word: finding for finding in found for word in words if word in finding.text}


@pytest.mark.parametrize("shape", ["sphere", "hills"])
@pytest.mark.parametrize("body", BODIES)
def test_gloss_is_neither_movement_nor_colour(tmp_path: Path, shape: str, body: str) -> None:
    images, mask = glossy(shape, body)
    assert alarms(tmp_path / "still", images, mask) == {}
    if body == "black":
        return  # its outline is in the dark: what it did cannot be told
    images[11:] = np.roll(images[11:], STEP, (1, 2))
    found = set(alarms(tmp_path / "bumped", images, mask)["moved"].images)
    after = {f"{number}.png" for number in range(12, 17)}
    assert len(found & after) >= 2 and len(found & after) > len(found - after)  # some are dark on the telling side


def test_a_coloured_lamp_on_glossy_plastic(tmp_path: Path) -> None:
    images, mask = glossy("hills", "blue")
    images[[3, 9], ..., 0] *= 0.7
    assert "colour changes" in alarms(tmp_path, images, mask)


def test_casts_are_measured() -> None:
    rng = np.random.default_rng(0)
    observations = rng.uniform(0.1, 0.9, (10, 200, 1)) * rng.uniform(0.3, 1.0, (200, 3))
    observations[4] *= [1.0, 1.0, 0.8]
    found = colour_casts(observations.astype(np.float32), np.inf)
    assert np.flatnonzero(found).tolist() == [4]
    assert found[4] == pytest.approx(1 - 0.8 ** (2 / 3), abs=0.01)  # against the mean of the channels' logarithms
    assert not colour_casts(np.zeros((4, 50, 3), np.float32), np.inf).any()


@pytest.mark.slow
@pytest.mark.parametrize("material", ["red-phenolic", "blue-fabric", "gold-metallic-paint"])
def test_a_rendered_bunny(tmp_path: Path, material: str) -> None:
    folder = photograph_bunny(tmp_path / "photographs", material)
    read = photos.load(folder)
    images, mask = read[0 : len(read)], read.mask
    assert alarms(tmp_path / "still", images, mask) == {}
    images[24:] = np.roll(images[24:], (6, -4), (1, 2))
    found = set(alarms(tmp_path / "bumped", images, mask)["moved"].images)
    after = {f"{number}.png" for number in range(25, 49)}
    assert len(found & after) > 12 and len(found - after) <= 2


def test_the_bench_counts_alarms_and_hits(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_data(tmp_path / "data", ("train",), lights=16, size=64)
    assert main(["bench-checks", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 0
    rows = json.loads((tmp_path / "out" / "bench_checks.json").read_text())["rows"]
    by_case = {row["case"]: row for row in rows}
    assert set(by_case) == set(bench_checks.CASES)
    assert not by_case["still"]["said"] and not by_case["white"]["said"]
    assert by_case["half"]["pictures"] == 8 and by_case["blue"]["pictures"] == 2
    assert "nothing wrong, said to have moved" in capsys.readouterr().out
    assert main(["bench-checks", str(tmp_path / "data"), "--every", "0"]) == 2
