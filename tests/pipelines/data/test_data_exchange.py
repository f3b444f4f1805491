"""`sdps data export`: which scenes, what is said of them, checks, and mistakes."""

import shutil
from pathlib import Path

import pytest
from exchange_support import write_folder

from pipelines.cli import main


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_folder(folder)
    return folder


@pytest.mark.parametrize(
    ("flags", "written"),
    [
        (["--split", "train", "--limit", "1"], ["blobby-00001-v0-m0"]),
        (["--ids", "sphere-gold", "blobby-00001-v1-m0"], ["blobby-00001-v1-m0", "sphere-gold"]),
    ],
)
def test_selection(data, tmp_path, flags, written):
    assert main(["data", "export", str(data), "--layout", "custom", "--out", str(tmp_path / "tree"), *flags]) == 0
    assert (tmp_path / "tree" / "objects.txt").read_text().split() == written


def test_the_command_line(data, tmp_path, capsys):
    out = str(tmp_path / "tree")
    assert main(["data", "export", str(data), "--layout", "psfcn", "--out", out, "--check", "--split", "train"]) == 0
    told = capsys.readouterr().out
    assert "2 scenes as psfcn, 2 written now, 0 kept\nclipped: 0.00%" in told and "val_mtrl.txt is empty" in told
    assert "2 samples of 5 lights; every rule of its loaders holds" in told
    (tmp_path / "tree" / "Images" / "blobby-00001-v0" / "blue-fabric" / "001.png").unlink()
    assert main(["data", "export", out, "--layout", "psfcn", "--check"]) == 1
    assert "001.png: no such picture" in capsys.readouterr().out
    for arguments, message in (
        (["--layout", "psfcn"], "--out is missing"),
        (["--layout", "psfcn", "--out", out, "--exposure", "loud"], "expected a positive number or 'auto'"),
        (["--layout", "psfn", "--out", out], "did you mean 'psfcn'"),
        (["--layout", "unips", "--out", out], "layout was 'psfcn'"),
        (["--layout", "psfcn", "--out", out, "--ids", "sphere-golt"], "unknown scene 'sphere-golt'; did you mean"),
        (["--layout", "psfcn", "--out", out, "--ids", "sphere-gold", "--split", "train"], "no scene of 4 is left"),
        (["--layout", "psfcn", "--out", out, "--limit", "0"], "--limit must be at least 1"),
    ):
        assert main(["data", "export", str(data), *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.strip().count("\n") == 0


def test_missing_shards(data, tmp_path, capsys):
    folder = tmp_path / "data"
    shutil.copytree(data, folder)
    (folder / "shards" / "sphere-gold.exr").unlink()
    command = ["data", "export", str(folder), "--layout", "unips", "--out", str(tmp_path / "tree")]
    assert main(command) == 2
    assert "1 of 4 shards are missing, the first is 'sphere-gold'" in capsys.readouterr().err
    assert main([*command, "--skip-missing"]) == 0
    assert "3 scenes as unips" in capsys.readouterr().out
