"""`sdps export` and the flags of `sdps infer` that do the same."""

import json
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest
from saved_results import save_result

from pipelines.cli import main
from sdps.surface.exports.registry import EXPORTS


def test_a_result_is_exported_and_exports_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    save_result(tmp_path / "result")
    assert main(["export"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(EXPORTS)
    assert main(["export", str(tmp_path / "result"), "--as", "height,LP", "--normals", "directx"]) == 0
    told = [Path(line) for line in capsys.readouterr().out.splitlines()]
    folder = tmp_path / "result" / "exports"
    assert all(path.is_file() for path in told)
    assert {path.relative_to(folder).parts[0] for path in told} == {"height", "lp", "normals-directx"}
    assert main(["export", str(tmp_path / "result"), "--as", "lp", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "lp" / "lights.lp").is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["result", "--as", "hight"], "did you mean 'height'"),
        (["result", "--normals", "open-gl"], "did you mean 'opengl'"),
        (["result", "--as", "bini,meshroom"], "again with --focal"),
        (["elsewhere", "--as", "lp"], "no result of `sdps infer`"),
        (["--as", "lp"], "name the folder"),
    ],
)
def test_what_cannot_be_written_ends_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, arguments: list[str], said: str
) -> None:
    save_result(tmp_path / "result")
    monkeypatch.chdir(tmp_path)
    assert main(["export", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_infer_exports_what_it_saved_and_says_what_it_cannot(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    ring = np.arange(8) * np.pi / 4
    lights = np.stack([0.6 * np.cos(ring), 0.6 * np.sin(ring), np.full(8, 0.8)], axis=-1)
    images, mask = folders.matte(lights, size=40)
    photos, out = folders.write_folder(tmp_path / "photos", images, mask), tmp_path / "out"
    flags = ["--method", "pf14", "--export", "meshroom,lp,ptm", "--normals", "opengl", "--out", str(out)]
    assert main(["infer", str(photos), *flags]) == 0
    said = capsys.readouterr().out
    assert "! meshroom was not exported: " in said and "again with --focal" in said
    assert (out / "exports" / "lp" / "lights.lp").is_file()
    assert (out / "exports" / "normals-opengl" / "normal.png").is_file()
    told = json.loads((out / "exports" / "ptm" / "ptm.json").read_text())
    assert (told["of"], told["lights"]) == ("photographs", 8)
    assert told["rms_error"] < 0.06
    assert main(["infer", str(photos), "--export", "nonsense", "--out", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()
