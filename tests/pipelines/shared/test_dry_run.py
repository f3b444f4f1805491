"""`sdps infer --dry-run`: what was understood and what would be done; and nothing written."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from sdps_scenes import hemisphere_lights

from pipelines.cli import main
from sdps.surface import workload

LIGHTS = hemisphere_lights(9, np.random.default_rng(0))
FAST = ["--method", "least-squares", "--intensities", "equal", "--lights"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images, mask = folders.matte(LIGHTS)
    made = folders.write_folder(tmp_path_factory.mktemp("photos"), images, mask, suffix=".png", bits=16)
    np.savetxt(made / "known.txt", LIGHTS)
    return made


def test_it_says_what_will_happen_and_writes_nothing(folder: Path, tmp_path: Path, capsys) -> None:
    before, out = sorted(folder.rglob("*")), tmp_path / "out"
    flags = [*FAST, str(folder / "known.txt"), "--focal", "900px", "--pixel-size", "0.1", "--out", str(out)]
    assert main(["infer", str(folder), *flags, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert sorted(folder.rglob("*")) == before and not out.exists()
    for part in ("9 photographs of 104x104", "files: 1.png to 9.png, 16-bit PNG",
                 "curve: linear", "from known.txt; intensities",
                 "focal length 900 px", "0.1 mm a pixel", "seconds, up to", "method: least-squares", "stages: ",
                 "the rest", "nothing was written"):  # fmt: skip
        assert part in said, (part, said)
    assert main(["infer", str(folder), *flags, "--anyway"]) == 0
    listed = said.split("results: ")[1].split(" into ")[0].split(", ")
    assert sorted(listed) == sorted(path.name for path in out.iterdir())


def test_what_would_stop_it_stops_it(folder: Path, tmp_path: Path, capsys) -> None:
    np.savetxt(tmp_path / "wrong.txt", LIGHTS * (1, 1, -1))
    assert main(["infer", str(folder), *FAST, str(tmp_path / "wrong.txt"), "--dry-run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--frame" in line


def test_a_scale_is_found_that_takes_less(folder: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = ["infer", str(folder), "--method", "pf14", "--dry-run", "--scale", "auto"]
    assert main(asked) == 0
    assert "9 photographs of 104x104" in capsys.readouterr().out
    monkeypatch.setattr(workload, "LONG", 3.01)  # a page takes three
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert "reduced by --scale 0." in said and "9 photographs of 104x104" not in said
    assert main(["infer", str(folder), "--scale", "half"]) == 2
    assert "--scale" in capsys.readouterr().err


def test_the_first_line_comes_before_slow_modules(folder: Path) -> None:
    code = "import sys; from pipelines.cli import build_parser; build_parser(sys.argv[1:])"
    late = f"{code}; print('torch' in sys.modules)"
    asked = [sys.executable, "-c", late, "infer", str(folder)]
    lines = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines[0] == f"looking at the photographs in {folder}"
