"""The seeded families and the registry: closed, smooth, outward, varied and reproducible."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from render import shapes
from render.shapes import primitives
from render.shapes.geometry.mesh import face_normals, unit
from render.shapes.sculpture import family
from render.shared.errors import InputError

BLOBS = [f"blobby:{seed}" for seed in range(7)]
# The first seed of every recipe.
FIRST = {family.recipe(seed): f"sculpture:{seed}" for seed in reversed(range(200))}
SCULPTURES = sorted(FIRST.values())


@pytest.fixture(scope="module")
def meshes():
    return {name: shapes.load(name) for name in (*BLOBS, *SCULPTURES)}


def edges(mesh):
    """Steps in position and normal along two edges of every triangle, each (2 F, 3)."""
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]]).T
    return mesh.vertices[ends[1]] - mesh.vertices[ends[0]], mesh.normals[ends[1]] - mesh.normals[ends[0]]


def curvedness(mesh):
    """Turn of the normal per unit length; 1 for the unit sphere."""
    step, turn = edges(mesh)
    return np.linalg.norm(turn, axis=1).mean() / np.linalg.norm(step, axis=1).mean()


def concave_share(mesh):
    """Share of edges along which the surface bends inward."""
    step, turn = edges(mesh)
    return ((step * turn).sum(axis=1) < 0).mean()


def test_every_recipe_is_drawn():
    assert set(FIRST) == set(family.RECIPES)


@pytest.mark.parametrize("name", [*BLOBS, *SCULPTURES])
def test_family_is_closed_smooth_and_outward(meshes, name):
    mesh = meshes[name]
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume > 0.02
    assert solid.body_count == 1
    flat = unit(face_normals(mesh.vertices.astype(np.float64), mesh.faces))
    assert (flat[:, None] * mesh.normals[mesh.faces]).sum(axis=2).mean() > 0.95
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-6)
    # Dense enough for 256 pixels: the typical edge is at most three of them.
    assert np.median(np.linalg.norm(edges(mesh)[0], axis=1)) < 3 * 2 / 256
    assert len(mesh.faces) < 200_000


def test_lumpiness_varies_between_blobs(meshes):
    values = [curvedness(meshes[name]) for name in BLOBS]
    assert max(values) > 1.5 * min(values)
    assert len({round(value, 3) for value in values}) == len(values)


def test_sculptures_are_more_curved_and_concave_than_blobs(meshes):
    for measure in (curvedness, concave_share):
        of_blobs, of_sculptures = ([measure(meshes[name]) for name in names] for names in (BLOBS, SCULPTURES))
        assert np.median(of_sculptures) > 1.3 * np.median(of_blobs)


def test_same_seed_gives_the_same_bytes_in_a_fresh_process(meshes):
    names = ["blobby:1", FIRST["bust"], "composition:8"]
    code = (
        "import hashlib, sys\nfrom render import shapes\nfor name in sys.argv[1:]:\n    mesh = shapes.load(name)\n"
        "    sys.stdout.write(hashlib.sha256(b''.join(a.tobytes() for a in "
        "(mesh.vertices, mesh.faces, mesh.normals))).hexdigest() + '\\n')"
    )
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}  # matrix products must not depend on it
    output = subprocess.run(
        [sys.executable, "-c", code, *names], capture_output=True, text=True, check=True, env=one_thread
    ).stdout
    for name, digest in zip(names, output.split(), strict=True):
        mesh = meshes.get(name) or shapes.load(name)
        arrays = (mesh.vertices, mesh.faces, mesh.normals)
        assert hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest() == digest


def test_sphere_normals_are_exact():
    mesh = shapes.load("sphere")
    assert np.array_equal(mesh.normals, mesh.vertices)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 1e-6
    assert len(mesh.faces) == 81_920
    assert curvedness(mesh) == pytest.approx(1, abs=1e-4)


def test_families_are_described():
    assert set(shapes.families()) == {"sphere", "bunny", "blobby:<seed>", "sculpture:<seed>", "composition:<seed>"}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("blobly:3", "blobby"),
        ("bunnny", "'bunny'"),
        ("blobby", "seed"),
        ("blobby:", "seed"),
        ("blobby:-1", "seed"),
        ("sculpture:1.5", "seed"),
        ("sphere:3", "takes no seed"),
        ("missing.obj", "no such mesh file"),
    ],
)
def test_bad_names_are_one_line_errors(name, message):
    with pytest.raises(InputError, match=message) as caught:
        shapes.load(name)
    assert "\n" not in str(caught.value)


def test_bunny_of_another_content_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path))
    monkeypatch.setattr(primitives, "_fetch_bunny", lambda path: b"ply another bunny")
    with pytest.raises(InputError, match="SHA-256"):
        shapes.load("bunny")
    assert not list(tmp_path.iterdir())
    (tmp_path / "StanfordBunny.ply").write_bytes(b"ply damaged")
    with pytest.raises(InputError, match=r"StanfordBunny\.ply: SHA-256"):
        shapes.load("bunny")


def test_bunny_without_an_index_names_the_remedy(monkeypatch, tmp_path):
    def refuse(command, **_):
        raise subprocess.CalledProcessError(1, command, stderr="ERROR: no index\n")

    monkeypatch.setenv("SDPS_CACHE", str(tmp_path))
    monkeypatch.setattr(primitives.subprocess, "run", refuse)
    with pytest.raises(InputError, match=r"no index.*place StanfordBunny\.ply"):
        shapes.load("bunny")


def test_bunny_is_fetched_and_stands_upright_facing_left(monkeypatch, tmp_path):
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path))
    try:
        path = primitives.bunny_file()
    except InputError as error:
        pytest.skip(f"no package index in reach: {error}")
    assert path.parent == tmp_path
    mesh = shapes.load("bunny")
    x, y, z = mesh.vertices.T
    # It sits on a flat base, its ears are the highest part, and its head is left of its tail.
    assert (mesh.normals[y < y.min() + 0.02, 1] < -0.8).mean() > 0.5
    assert x[y > y.max() - 0.1].mean() < 0 < x[(y < 0) & (x > x.max() - 0.1)].mean()
    assert np.ptp(x) > np.ptp(z)
    outward = (mesh.normals * mesh.vertices).sum(axis=1)
    assert (outward > 0).mean() > 0.8
