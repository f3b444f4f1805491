"""Small meshes and one-call renders for the renderer's tests."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from render import shapes
from render.backend.jit import dr
from render.kernel import many_lights, scene
from render.materials.kernels.packed import PackedSurfaces, pack
from render.records.manifest import View
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


def cap(angle: float = 75.0, rings: int = 40, segments: int = 96) -> TriangleMesh:
    """Return the part of the unit sphere within `angle` degrees of -z, seen from inside, with exact inward normals.

    Open towards the camera. Between any two patches of a sphere the form factor is the same, so that interreflections
    in it are known in closed form.
    """
    theta = np.radians(angle) * np.arange(1, rings + 1) / rings
    phi = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.outer(np.sin(theta), np.cos(phi)), np.outer(np.sin(theta), np.sin(phi)),
                     np.repeat(-np.cos(theta)[:, None], segments, 1)], axis=2)  # fmt: skip
    vertices = np.concatenate([[[0, 0, -1]], ring.reshape(-1, 3)])
    this, other = np.arange(segments), (np.arange(segments) + 1) % segments
    faces = [np.stack([np.zeros_like(this), 1 + this, 1 + other], axis=1)]
    for inner in range(1, 1 + (rings - 1) * segments, segments):
        outer = inner + segments
        faces.append(np.stack([inner + this, outer + this, outer + other], axis=1))
        faces.append(np.stack([inner + this, outer + other, inner + other], axis=1))
    return TriangleMesh(vertices=vertices, faces=np.concatenate(faces).astype(np.uint32), normals=-vertices)


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """Return several meshes as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces.astype(np.int64) + start for mesh, start in zip(meshes, first[:-1], strict=True)]
    return TriangleMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
    )


def ball(radius: float, centre: Sequence[float]) -> TriangleMesh:
    """Return a sphere."""
    sphere = shapes.load("sphere")
    return replace(sphere, vertices=sphere.vertices * radius + np.array(centre, np.float32))


def spread(count: int, lowest: float = -1.0) -> np.ndarray:
    """Return (count, 3) float32 directions spread evenly, each for the same solid angle, over heights z > `lowest`."""
    z = 1 - (np.arange(count) + 0.5) / count * (1 - lowest)
    phi = np.arange(count) * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - z**2)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=1).astype(np.float32)


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
        scene.build(mesh), view or View(), pack(names, mesh), lights, size=size, spp=spp, bounces=bounces, seed=seed
    )
    return truth, dict(images)


def compiled(action) -> int:
    """Return the number of kernels that `action()` compiles."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        return sum(not kernel["cache_hit"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
