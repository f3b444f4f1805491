"""What `infer` writes: a folder with a result.json holds files of one run."""

import errno
from pathlib import Path

import numpy as np
import photo_folders as folders
import pytest

import sdps
from render.shared.errors import InputError


def test_a_run_that_is_cut_off_leaves_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring = np.arange(12) * np.pi / 6
    images, _ = folders.matte(np.stack([0.8 * np.cos(ring), 0.8 * np.sin(ring), np.full(12, 0.6)], axis=-1))
    photos = sdps.load(folders.write_folder(tmp_path / "photos", images))
    found = sdps.infer(photos, "pf14", findings=())
    out = tmp_path / "out"
    names = {path.name for path in found.save(out)}
    assert {"result.json", "normal.npy", "mesh.ply"} <= names and (out / "result.json").exists()
    replace, moved = Path.replace, []

    def replace_three(self: Path, target: Path) -> Path:
        moved.append(self)
        if len(moved) > 3:
            raise OSError(errno.EIO, "Input/output error")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", replace_three)
    with pytest.raises(InputError, match="cannot be written"):
        found.save(out)
    assert not (out / "result.json").exists() and np.load(out / "normal.npy").shape == found.normals.shape
