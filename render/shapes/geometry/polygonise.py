"""From a signed distance field to a closed triangle mesh with the field's own normals."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from render.shapes.geometry.mesh import TriangleMesh, unit, without_unused
from render.shapes.geometry.sdf import Field

BLOCK = 4  # grid points along an edge of the blocks in which the field is evaluated
CHUNK = 32768  # points per call: a few intermediate arrays of this size stay in the cache
SAFETY = 2.0  # how much steeper than a distance a field may be before blocks are missed at first


def polygonise(field: Field, *, half_size: float, triangles: int = 90_000) -> TriangleMesh:
    """Mesh the surface where `field` is zero: marching cubes (Lewiner et al. 2003) on blocks near the surface.

    Vertices then take one Newton step onto the exact surface, and normals are the field's gradient there by
    central differences, so relief finer than the cells still shades correctly.

    Args:
        field: Signed distance, negative inside; the solid lies within the cube |x|, |y|, |z| < `half_size`.
        half_size: Half the edge of that cube.
        triangles: About how many triangles to make; sets the spacing of the grid.

    Returns:
        The largest connected surface, watertight, without inner cavities.

    Raises:
        ValueError: the field has no surface in the cube.
    """
    low, high, area = _survey(field, half_size)
    spacing = np.float32(np.sqrt(2.8 * area / triangles))
    blocks = np.ceil((high - low) / (spacing * BLOCK)).astype(int) + 1
    values = _evaluate_near_surface(field, low, spacing, blocks)
    # The frame of outside points closes the surface even where it touches the edge of the grid.
    vertices, faces, _, _ = marching_cubes(np.pad(values, 1, constant_values=1.0), 0.0, gradient_direction="descent")
    vertices, faces = largest_component(vertices, faces.astype(np.int64))
    vertices = (vertices - 1) * spacing + low.astype(np.float32)
    points, normals = _move_to_surface(field, np.ascontiguousarray(vertices.T), spacing)
    return TriangleMesh(vertices=points.T, faces=faces, normals=normals)


def evaluate(field: Field, points: np.ndarray) -> np.ndarray:
    """Evaluate `field` at `points` (3, N) in pieces that fit the cache; returns (N,) float32."""
    starts = range(0, points.shape[1], CHUNK)
    return np.concatenate([field(np.ascontiguousarray(points[:, start : start + CHUNK])) for start in starts])


def largest_component(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the connected surface with the most triangles; returns (vertices, faces)."""
    count = len(vertices)
    ends = (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())
    graph = coo_array((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    if parts > 1:
        of_face = label[faces[:, 0]]
        faces = faces[of_face == np.bincount(of_face).argmax()]
    return without_unused(vertices, faces)


def _survey(field: Field, half_size: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Find on a coarse grid the surface's bounding box (low, high) and its approximate area."""
    count = 40
    axis = np.linspace(-half_size, half_size, count, dtype=np.float32)
    step = axis[1] - axis[0]
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")).reshape(3, -1)
    values = evaluate(field, points)
    near = points[:, values < step]
    if not near.shape[1]:
        raise ValueError("the field is positive everywhere: there is no surface to mesh")
    area = max(int((np.abs(values) < step / 2).sum()), 100) * float(step) ** 2
    return near.min(axis=1) - step, near.max(axis=1) + step, area


def _evaluate_near_surface(field: Field, low: np.ndarray, spacing: np.float32, blocks: np.ndarray) -> np.ndarray:
    """Sample the grid of `blocks` * BLOCK points, exactly in blocks near the surface, elsewhere by sign only."""
    origin = low.astype(np.float32)[:, None]
    index = np.indices(tuple(blocks)).reshape(3, -1)
    middle = np.float32((BLOCK - 1) / 2)
    centres = evaluate(field, origin + (index * BLOCK + middle).astype(np.float32) * spacing)
    # Grid points of a block are at most this far from its centre, and surface cells reach one spacing further.
    reach = spacing * (np.sqrt(3) * middle + 1) * SAFETY
    active = np.abs(centres) < reach
    # (bx, by, bz, 4, 4, 4) holds each block contiguously; a transpose makes the grid of it.
    values = np.repeat(np.where(centres < 0, np.float32(-1), np.float32(1)), BLOCK**3).reshape(-1, BLOCK**3)
    inner = np.indices((BLOCK,) * 3).reshape(3, 1, -1)
    done = np.zeros(len(active), dtype=bool)
    while active.any():
        points = origin[:, :, None] + (index[:, active, None] * BLOCK + inner).astype(np.float32) * spacing
        values[active] = evaluate(field, points.reshape(3, -1)).reshape(-1, BLOCK**3)
        done |= active
        grid = values.reshape(*blocks, BLOCK, BLOCK, BLOCK).transpose(0, 3, 1, 4, 2, 5).reshape(blocks * BLOCK)
        active = _crossing_cells(grid < 0, blocks).ravel() & ~done
    # A value of exactly zero would give triangles without area.
    small = np.float32(1e-4) * spacing
    grid[np.abs(grid) < small] = small
    return grid


def _crossing_cells(inside: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Mark the blocks with a sign change at or across their border: those must be evaluated."""
    marked = np.zeros(blocks, dtype=bool)
    for axis in range(3):
        change = np.diff(inside, axis=axis)
        where = np.argwhere(change)
        marked[tuple((where // BLOCK).T)] = True
        where[:, axis] += 1
        marked[tuple((where // BLOCK).T)] = True
    return marked


def _move_to_surface(field: Field, points: np.ndarray, spacing: np.float32) -> tuple[np.ndarray, np.ndarray]:
    """Move `points` (3, V) one Newton step towards the zero level; returns them with unit normals (V, 3)."""
    step = np.float32(0.3) * spacing
    steps = step * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)[:, :, None]
    samples = np.stack([evaluate(field, points + offset) for offset in steps])  # (6, V)
    gradient = (samples[:3] - samples[3:]) / (2 * step)
    squared = np.maximum((gradient**2).sum(axis=0), np.float32(0.05))
    shift = np.clip(-samples.mean(axis=0) / squared, -0.5 * spacing, 0.5 * spacing)
    normals = unit(gradient.T)
    # A vanishing gradient (the ridge between two equal parts) has no direction; up is as good as any.
    normals[np.abs(normals).max(axis=1) == 0] = (0, 1, 0)
    return points + shift * gradient, normals
