"""Framing measured on the mesh agrees with what the renderer sees."""

from dataclasses import replace

import numpy as np
import pytest

from render.planning.framing import measure, rasterise, tile_view
from render.planning.plan import DataConfig, random_view
from render.records.manifest import SceneSpec, View
from render.records.shards import read_shard
from render.running import scene_rendering
from render.shapes import load
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.seeds import generator


@pytest.mark.parametrize(
    ("shape", "tiles", "camera"), [("blobby:2", 1, None), ("sculpture:1", 4, None), ("blobby:2", 1, 1.8)]
)
def test_estimate_equals_a_real_render(shape, tiles, camera, tmp_path):
    config = DataConfig(upright_scale=(0.8, 1.0))
    mesh, scenes, expected = load(shape), [], []
    for number in range(3):
        view = random_view(config, shape.split(":")[0], generator(number, "framing"))
        view = replace(view, camera_distance=camera)
        framing = measure(mesh, view, tiles)
        row, column = (
            np.unravel_index(np.argsort(framing.foreground.ravel())[-1 - number], (tiles, tiles))
            if tiles > 1
            else (0, 0)
        )
        expected.append((framing.foreground[row, column], framing.spread[row, column]))
        scenes.append(SceneSpec(
            id=f"s{number}", seed=0, split="test", shape=shape, material="lambertian:0.5",
            view=tile_view(view, int(row), int(column), tiles), lights=((0.0, 0.0, 1.0),), size=64, spp=4, bounces=0,
        ))  # fmt: skip
    scene_rendering.render_scenes(scenes, tmp_path)
    for scene, (foreground, spread) in zip(scenes, expected, strict=True):
        shard = read_shard(tmp_path / scene.file, scene)
        mean = np.linalg.norm(shard.normals[shard.mask].mean(0))
        assert shard.coverage.mean() == pytest.approx(foreground, abs=0.03)
        assert np.degrees(np.arccos(mean)) == pytest.approx(spread, abs=3)


def test_a_sphere_and_a_facet():
    sphere = measure(load("sphere"), View(scale=0.9))
    assert sphere.foreground[0, 0] == pytest.approx(np.pi / 4 * 0.81, abs=0.01)
    assert sphere.spread[0, 0] == pytest.approx(np.degrees(np.arccos(2 / 3)), abs=1)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    square = TriangleMesh(
        vertices=np.concatenate([corners, corners * 0.5 + [0, 0, 0.5]]),
        faces=np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
        normals=np.tile([0.0, 0.0, 1.0], (8, 1)),
    )
    tiles = measure(square, View(scale=0.75, offset=(0.25, 0.25)), tiles=2)  # it fills [-0.5, 1] in x and y
    np.testing.assert_allclose(tiles.foreground, [[0.5, 1.0], [0.25, 0.5]])
    assert not tiles.spread.any()
    faces = rasterise(square, View(), 8)  # large triangles, the nearer square in front
    assert set(faces[2:6, 2:6].ravel()) == {2, 3} and set(faces[0]) <= {0, 1}


def test_an_empty_frame():
    framing = measure(load("blobby:2"), View(scale=0.1, offset=(3.0, 0.0)))
    assert framing.foreground[0, 0] == 0 and framing.spread[0, 0] == 0


def test_tiles_join_into_the_image():
    mesh, view = load("sculpture:1"), View(scale=0.9, offset=(0.1, -0.05))
    whole = rasterise(mesh, view, 64) >= 0
    for row in range(2):
        for column in range(2):
            part = rasterise(mesh, tile_view(view, row, column, 2), 32) >= 0
            same = whole[32 * row : 32 * row + 32, 32 * column : 32 * column + 32] == part
            assert same.mean() > 0.998  # a centre on an edge may fall to either side
