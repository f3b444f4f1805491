"""Meshes of the user's own by name: `meshes:<axis that is up>:<first digits of the file's SHA-256>:<path>`.

The digits tie a plan to the file's content: a file that was changed or moved since is reported, not rendered.
"""

import hashlib
from pathlib import Path

import numpy as np

from render.records.manifest import OWN_MESHES
from render.shapes.files.mesh_file import load_mesh
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.errors import InputError, unknown

_DIGITS = 12
# Rotations that take the axis of the file that is up to y, (3, 3) on column vectors; z up is a tip backwards.
TO_Y = {
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


def name_of(path: Path, up: str) -> str:
    """Return the name of a mesh file as it is now, whose axis `up` (x, y or z) is up.

    Raises:
        InputError: the file cannot be read.
    """
    return f"{OWN_MESHES}:{up}:{_digits(path)}:{path.as_posix()}"


def path_of(name: str) -> Path:
    """Return the file of a name."""
    return Path(name.split(":", 3)[-1])


def load_named(name: str) -> TriangleMesh:
    """Read the mesh of a name, y up, in the unit sphere.

    Raises:
        InputError: a malformed name, or a file that is missing, was changed, or cannot be used.
    """
    _, *fields = name.split(":", 3)
    if len(fields) < 3:
        raise InputError(
            f"shape {name!r}: expected {OWN_MESHES}:<axis>:<SHA-256>:<path>, as `sdps data plan` writes it"
        )
    up, digits, text = fields
    if up not in TO_Y:
        raise unknown(f"axis of shape {name!r}:", up, TO_Y)
    path = Path(text)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file; the plan expects it at {path.absolute()}; put it back there")
    found = _digits(path)
    if found != digits:
        raise InputError(
            f"{path}: changed since the plan was made (SHA-256 {found}, planned {digits}); put the former file back, "
            "or plan again into another --out"
        )
    return load_mesh(path).rotate(TO_Y[up]).normalise()


def _digits(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGITS]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
