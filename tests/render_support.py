"""Small meshes and one-call renders for the renderer's tests."""

from collections.abc import Sequence

import drjit as dr
import numpy as np

from render import many_lights, scene
from render.manifest import View
from render.materials.packed import PackedSurfaces, pack
from render.shapes import TriangleMesh


def packed(*names: str) -> PackedSurfaces:
    return pack(names)


def plane() -> TriangleMesh:
    """Return the square |x|, |y| <= 1 that faces the camera."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    return TriangleMesh(vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]], np.uint32), normals=normals)


def bowl(steps: int = 40, depth: float = 1.3) -> TriangleMesh:
    """Return a paraboloid open towards the camera, z = depth (r^2 - 1/2), with exact normals on its inside."""
    axis = np.linspace(-0.8, 0.8, steps)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    vertices = np.stack([x, y, depth * (x**2 + y**2 - 0.5)], axis=1)
    normals = np.stack([-2 * depth * x, -2 * depth * y, np.ones_like(x)], axis=1)
    corner = (np.arange(steps - 1)[:, None] * steps + np.arange(steps - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + steps + 1], axis=1)
    upper = np.stack([corner, corner + steps + 1, corner + steps], axis=1)
    return TriangleMesh(
        vertices=vertices.astype(np.float32),
        faces=np.concatenate([lower, upper]).astype(np.uint32),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
    )


def unit(*vectors: Sequence[float]) -> np.ndarray:
    """Return the rows as unit vectors (L, 3) float32."""
    rows = np.array(vectors, np.float64)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def render(
    mesh: TriangleMesh, *names: str, lights: np.ndarray, view: View | None = None, size: int = 32, spp: int = 16,
    bounces: int = 0, seed: int = 0,
) -> tuple[many_lights.GroundTruth, dict[int, np.ndarray]]:  # fmt: skip
    """Render a mesh with the named materials; return the ground truth and the images by material number."""
    truth, images = many_lights.render(
        scene.build(mesh), view or View(), packed(*names), lights, size=size, spp=spp, bounces=bounces, seed=seed
    )
    return truth, dict(images)


def compiled(action) -> int:
    """Return the number of kernels that `action()` compiles."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        return sum(not kernel["cache_hit"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
