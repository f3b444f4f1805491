"""What is said before an inference begins: minutes, memory, and a scale where these are too much."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from sdps_scenes import hemisphere_lights

import sdps
from render.shared.errors import InputError
from sdps.api import make_runner
from sdps.photos import Photographs, load
from sdps.surface import workload as workloads
from sdps.surface.workload import LIMIT, workload

LIGHTS = hemisphere_lights(9, np.random.default_rng(0))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    folder = tmp_path_factory.mktemp("photos")
    images, mask = folders.matte(LIGHTS)
    return load(folders.write_folder(folder, images, mask, suffix=".jpg", bits=8))


def larger(photos: Photographs, height: int, width: int, count: int, share: float = 1.0) -> Photographs:
    """Return photographs that seem to be many and large; only a mask is in memory."""
    mask = np.zeros((height, width), bool)
    mask[: round(height * share**0.5), : round(width * share**0.5)] = True
    return replace(photos, shape=mask.shape, mask=mask, files=tuple(f"{number}.jpg" for number in range(count)))


def test_one_line_says_pixels_pictures_minutes_and_memory(photos: Photographs) -> None:
    line = sdps.api.plan(larger(photos, 3000, 4000, 7, 0.18), lit_by="lamp").describe()
    assert re.fullmatch(
        r"2\.2 million pixels of object in 7 pictures of 4000x3000: about [\d.]+ (seconds|minutes|hours), up to "
        r"\d\.\d GiB of memory(; --scale 0\.5 would take about .*)?", line,
    ), line  # fmt: skip


@pytest.mark.parametrize(
    "method", ["sdps-frames", "sdps-frames+refine", "sdps-frames+fuse", "sdps", "lcnet+robust-least-squares"]
)
@pytest.mark.parametrize(("height", "width", "count"), [(4000, 6000, 100), (4000, 6000, 8), (3000, 4000, 1000)])
def test_any_ordinary_camera_fits(photos: Photographs, method: str, height: int, width: int, count: int) -> None:
    runner = make_runner(method, (False, False), None, None, None)
    found = workload(larger(photos, height, width, count), runner)
    assert found.gib <= LIMIT
    found.check()


def test_long_ones_propose_a_scale(photos: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workloads, "time_normals", lambda *_: 1.0)
    monkeypatch.setattr(workloads, "time_lights", lambda *_: 0.004)
    found = sdps.api.plan(larger(photos, 4000, 6000, 9))
    assert found.total > 600 and found.smaller is not None
    scale, seconds, gib = found.smaller
    assert scale == 0.5 and gib < found.gib and 0.15 * found.total < seconds < 0.5 * found.total
    assert "--scale 0.5 would take about" in found.describe()
    assert sdps.api.plan(photos).smaller is None
    slow = sdps.api.plan(larger(photos, 4000, 6000, 9), discontinuities=True)
    assert slow.seconds["depth"] > 10 * found.seconds["depth"]


def test_networks_count_as_fast_as_they_are_here(photos: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    """A processor on which the network takes 1.5 times as long makes its part 1.5 times as long, and no other."""
    monkeypatch.setattr(workloads, "time_lights", lambda *_: 0.004)
    found = []
    for slower in (1.0, 1.5, 2.0):
        monkeypatch.setattr(workloads, "time_normals", lambda *_, slower=slower: slower)
        found.append(sdps.api.plan(larger(photos, 600, 800, 96)).seconds)
    network = found[2]["normals"] - found[0]["normals"]  # without reading the pictures
    assert found[1]["normals"] - found[0]["normals"] == pytest.approx(network / 2)
    assert 0.9 < network / (2.1e-6 * 96 * 480_000) < 1.2
    assert all(found[0][name] == found[2][name] for name in found[0] if name not in ("normals", "second look"))


def test_flat_things_are_looked_at_once_more(photos: Photographs) -> None:
    """What fills the frame may be one, unless lights are given or it is said to be none."""
    whole = larger(photos, 2000, 3000, 100)
    found = sdps.api.plan(whole).seconds
    once = 32 * 2000 * 3000 * 27e-9  # decoded and made linear
    assert once < found["flat"] < 4 * once
    assert "flat" not in sdps.api.plan(whole, flat="no").seconds
    assert "flat" not in sdps.api.plan(larger(photos, 2000, 3000, 100, 0.5), lit_by="lamp").seconds
    assert "flat" in sdps.api.plan(larger(photos, 2000, 3000, 100, 0.5), flat="yes").seconds
    lit = replace(whole, light_directions=np.tile([[0.0, 0.0, 1.0]], (100, 1)).astype(np.float32))
    assert "flat" not in sdps.api.plan(lit).seconds


def test_what_cannot_be_held_says_so_with_the_remedy(photos: Photographs) -> None:
    many = larger(photos, 3000, 4000, 60)
    with pytest.raises(InputError, match=r"12\.0 million pixels .* GiB of memory, more than 4; give --scale 0\.\d+"):
        sdps.infer(many, "pf14", findings=())
    found = sdps.api.plan(many, "pf14")
    assert found.gib > LIMIT and found.smaller is not None and found.smaller[2] <= LIMIT
    assert sdps.api.plan(larger(photos, 3000, 4000, 3), "pf14").gib < found.gib


def test_a_reduced_set_says_the_scale_of_the_files(photos: Photographs) -> None:
    half = replace(larger(photos, 4000, 6000, 9), scale=0.5)  # of pictures of 96 megapixels
    found = sdps.api.plan(half)
    assert found.smaller is not None and found.smaller[0] == 0.25


@pytest.mark.parametrize(
    ("seconds", "text"), [(3, "5 seconds"), (72, "70 seconds"), (660, "11 minutes"), (6500, "1.8 hours")]
)
def test_durations_are_rounded(seconds: float, text: str) -> None:
    assert workloads._duration(seconds) == text
    assert Path(workloads.__file__).is_file()
