"""From normals to depth, by masked least squares on the graph of neighbouring pixels.

Under perspective the unknown is w = -f log(1 - z / f), and n . v', v' a pixel's line of sight (`Camera.sights`), takes
the place of n_z; the equations stay. "facing" is the one or the other.

Legend: (H, W) image sides, n mask pixels, m edges between neighbours of the mask. An edge runs from pixel a to pixel b,
one column to its right or one row above it, so that along it x or y grows by 1.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from render.shared.errors import InputError
from render.shared.progress import share, stage
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.core.laplacian import laplacian, multigrid, solve
from sdps.core.large_depth import Cycle, Edges, Slopes, bilateral_edges, measure, right_side, smooth_edges, solve_grid

STEEPEST = 0.03
"""Least n_z (n . v') that is believed, so that slopes stop at 33. Half a pixel inside the rim of a sphere of radius R
pixels, n_z is sqrt(1 / R), so this is the rim of R = 1100."""
_TOLERANCE = 1e-7  # of the linear system
_ROUGH = 1e-4  # the same while weights still change
_SETTLED = 1e-3
_OUTWORN = 12  # steps of a solve after which the preconditioner is rebuilt for the changed weights
_WEAKEST = 1e-6  # weight of an edge that both of its equations have left
LARGE = 1_000_000
"""Pixels above which the grid is solved in place (`sdps.core.large_depth`); a graph of so many takes 0.7 GiB."""
_BAND = 2**18  # pixels looked at at once


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth of a surface; `camera.positions(z)` are its points.

    Attributes:
        z: (H, W) float32, towards the camera (nearer is larger), in pixel widths at the mean depth; 0 outside the mask.
            Its mean over each component is 0; under perspective, that of w, which scales each component so that the
            geometric mean of its distances to the camera is the focal length.
        mask: (H, W) bool.
        labels: (H, W) int32, number of the connected component (4 neighbours) from 0, -1 outside the mask. How far one
            component lies before another (under perspective: how large it is) is not in the normals.
        components: Number of components.
        residuals: (H, W) float32, angle in degrees between an edge of the surface and the tangent plane of the mean of
            its two normals: RMS over a pixel's edges, 0 outside the mask and at pixels without neighbours. Under
            perspective w stands for z.
        residual: RMS of the same over all edges; 0 for an integrable map, up to discretisation.
        below: Share of mask pixels whose n_z (n . v') was under `STEEPEST` and was raised to it.
        torn: Share of edges taken for discontinuities (weight under 1 % of a smooth edge's); 0 without
            `discontinuities`.
        iterations: Linear systems solved.
        seconds: Wall time.
        camera: The camera that saw the normals.
    """

    z: np.ndarray
    mask: np.ndarray
    labels: np.ndarray
    components: int
    residuals: np.ndarray
    residual: float
    below: float
    torn: float
    iterations: int
    seconds: float
    camera: Camera = ORTHOGRAPHIC


@dataclass(frozen=True, eq=False)
class _Graph:
    """Edges with the normals' components along them.

    Attributes:
        edges: (2, m) pixels a and b.
        count: n.
        along: (2, m) float64, n_x or n_y at a and b.
        facing: (2, m) float64, n_z (n . v') at a and b, at least `STEEPEST`.
        before, after: (m,) the edge of the same direction that ends at a, and that which starts at b; -1 for none.
    """

    edges: np.ndarray
    count: int
    along: np.ndarray
    facing: np.ndarray
    before: np.ndarray
    after: np.ndarray


def integrate(
    normals: np.ndarray,
    mask: np.ndarray,
    *,
    camera: Camera = ORTHOGRAPHIC,
    discontinuities: bool = False,
    sharpness: float = 2.0,
    most: int = 100,
) -> Depth:
    """Find the depth whose slopes fit the normals best.

    Without `discontinuities` the mean normal of an edge's two pixels shall be perpendicular to the chord between them:
    the sum of ((a_z + b_z) (z_b - z_a) + a_x + b_x)^2 / 4 over edges is least (y for x on edges that run up).
    Multiplied by n_z, not divided by it, steep pixels do not dominate. The chords of a sphere obey this exactly.

    With `discontinuities` each pixel has a one-sided equation per neighbour, n_z (z' - z) + n_x = 0, and of the two
    neighbours left and right, or above and below, the one across the smaller step counts more. These are the bilateral
    weights of Cao et al., Bilateral Normal Integration (ECCV 2022):
    sigmoid(k ((n_z dz of the other side)^2 - (n_z dz of this side)^2)), found again until the energy settles.

    Args:
        normals: (H, W, 3) camera frame (x right, y up, z to the camera), of any length and real type; not read
            outside the mask.
        mask: (H, W) bool.
        camera: The camera that saw them.
        discontinuities: Let depth jump where neighbouring slopes disagree.
        sharpness: k of the weights.
        most: Reweightings at most.

    Raises:
        InputError: sizes that differ, an empty mask, NaN, infinite or zero normals inside it.
    """
    started = time.perf_counter()
    large = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and int(mask.sum()) > LARGE
    unit = None if large else check_normals(normals, mask)
    if not (sharpness > 0 and most >= 1):
        raise InputError(f"sharpness must be positive and most at least 1, got {sharpness} and {most}")
    stage("depth")
    if unit is None:
        return _integrate_large(np.asarray(normals), mask, camera, sharpness if discontinuities else 0.0, most, started)
    facing = _facing(unit, mask, camera)
    graph, below = _graph(unit, facing, mask), float((facing < STEEPEST).mean())
    z, weights, iterations = *_smooth(graph), 1
    if discontinuities and len(weights):
        z, weights, iterations = _bilateral(graph, z, sharpness, most)
    torn = (weights < 0.01 * (graph.facing**2).mean(axis=0)).mean() if discontinuities and len(weights) else 0.0
    return Depth(
        mask=mask, below=below, torn=float(torn), iterations=iterations, **_lay_out(graph, mask, z, camera),
        seconds=time.perf_counter() - started, camera=camera,
    )  # fmt: skip


def check_normals(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mask's unit normals (n, 3) float64 in row order, or refuse them as `integrate` says."""
    normals, mask = np.asarray(normals), np.asarray(mask)
    if mask.ndim != 2 or mask.dtype != np.bool_ or normals.shape != (*mask.shape, 3):
        raise InputError(
            f"normals must be (H, W, 3) and the mask bool (H, W), got {normals.shape} and {mask.dtype} {mask.shape}"
        )
    if not mask.any():
        raise InputError("the mask is empty, so there is no surface; mark the object's pixels")
    inside = normals[mask].astype(np.float64)
    lengths = np.linalg.norm(inside, axis=1)
    for wrong, text in ((~np.isfinite(lengths), "NaN or infinite"), (lengths <= 1e-6, "zero")):
        if wrong.any():
            raise InputError(f"the normals of {wrong.sum()} mask pixels are {text}; take these pixels out of the mask")
    return inside / lengths[:, None]


def _facing(unit: np.ndarray, mask: np.ndarray, camera: Camera) -> np.ndarray:  # (n,)
    """Return n . v' of unit normals (n, 3)."""
    if not camera.is_perspective:
        return unit[:, 2]
    rows, columns = np.nonzero(mask)  # of the mask alone: pictures are large
    return (unit * camera.look(mask.shape, rows, columns)).sum(axis=-1)


def _graph(unit: np.ndarray, facing: np.ndarray, mask: np.ndarray) -> _Graph:
    """Connect each mask pixel to those on its right and above it."""
    count = len(unit)
    index = np.full(mask.shape, -1, np.int64)
    index[mask] = np.arange(count)
    facing = np.maximum(facing, STEEPEST)
    parts, offset = [], 0
    for axis, near, far in ((0, index[:, :-1], index[:, 1:]), (1, index[1:], index[:-1])):
        both = (near >= 0) & (far >= 0)
        edges = np.stack([near[both], far[both]])
        starting, ending = np.full((2, count), -1)
        number = np.arange(offset, offset + edges.shape[1])
        starting[edges[0]], ending[edges[1]] = number, number
        parts.append((edges, unit[edges, axis], ending[edges[0]], starting[edges[1]]))
        offset += edges.shape[1]
    edges, along, before, after = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    return _Graph(edges, count, along, facing[edges], before, after)


def _smooth(graph: _Graph) -> tuple[np.ndarray, np.ndarray]:
    """Solve with the mean normal of every edge; return depth (n,) and weights (m,)."""
    if not graph.edges.size:
        return np.zeros(graph.count), np.zeros(0)
    facing = graph.facing.mean(axis=0)
    matrix, right = _system(graph, facing**2, -graph.along.mean(axis=0) / facing)
    cycle = multigrid(matrix)
    return solve(matrix, right, np.zeros(graph.count), cycle, tolerance=_TOLERANCE)[0], facing**2


def _bilateral(graph: _Graph, z: np.ndarray, sharpness: float, most: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Reweight the one-sided equations until their energy changes by less than a thousandth."""
    energy, iterations, cycle = np.inf, 1, None
    for _ in range(most):
        iterations += 1
        shares = _shares(graph, z, sharpness)
        weights = (shares * graph.facing**2).sum(axis=0) + _WEAKEST
        # The last term holds a step that no equation ties any more where it was.
        target = (_WEAKEST * _steps(graph, z) - (shares * graph.facing * graph.along).sum(axis=0)) / weights
        matrix, right = _system(graph, weights, target)
        cycle = cycle or multigrid(matrix)
        z, steps = solve(matrix, right, z, cycle, tolerance=_ROUGH)
        if steps > _OUTWORN:
            cycle = None
        last, energy = energy, float((shares * (graph.facing * _steps(graph, z) + graph.along) ** 2).sum())
        if abs(last - energy) <= _SETTLED * energy:
            break
    return z, weights, iterations


def _system(graph: _Graph, weights: np.ndarray, target: np.ndarray) -> tuple[csr_matrix, np.ndarray]:
    """Return matrix and right side of the least sum of weights (z_b - z_a - target)^2."""
    flow = weights * target
    right = np.bincount(graph.edges[1], flow, graph.count) - np.bincount(graph.edges[0], flow, graph.count)
    return laplacian(graph.edges, weights, graph.count), right


def _steps(graph: _Graph, z: np.ndarray) -> np.ndarray:  # (m,)
    return z[graph.edges[1]] - z[graph.edges[0]]


def _shares(graph: _Graph, z: np.ndarray, sharpness: float) -> np.ndarray:
    """Return the weights (2, m) of the edges' equations at a and at b; 1/2 where nothing is on a pixel's other side."""
    steps = _steps(graph, z)
    shares = np.full((2, len(steps)), 0.5)
    for end, other in enumerate((graph.before, graph.after)):
        there = other >= 0
        facing = graph.facing[end, there] ** 2
        difference = facing * (steps[other[there]] ** 2 - steps[there] ** 2)
        shares[end, there] = 1.0 / (1.0 + np.exp(np.clip(-sharpness * difference, -60.0, 60.0)))
    return shares


def _lay_out(graph: _Graph, mask: np.ndarray, z: np.ndarray, camera: Camera) -> dict[str, Any]:
    """Centre the components, measure the residuals, and return both as `Depth` holds them."""
    joined = coo_matrix((np.ones(graph.edges.shape[1], np.int8), tuple(graph.edges)), (graph.count, graph.count))
    components, labels = connected_components(joined, directed=False)
    z = z - (np.bincount(labels, z) / np.bincount(labels))[labels]
    slopes = -graph.along.mean(axis=0) / graph.facing.mean(axis=0)
    squared = np.degrees(np.arctan(_steps(graph, z)) - np.arctan(slopes)) ** 2  # (m,)
    ends = graph.edges.ravel()
    total, number = np.bincount(ends, np.tile(squared, 2), graph.count), np.bincount(ends, minlength=graph.count)

    def picture(values: np.ndarray, outside: int) -> np.ndarray:
        image = np.full(mask.shape, outside, np.int32 if values.dtype.kind == "i" else np.float32)
        image[mask] = values
        return image

    return {
        "z": picture(camera.height(z), 0),
        "labels": picture(labels, -1),
        "components": int(components),
        "residuals": picture(np.sqrt(total / np.maximum(number, 1)), 0),
        "residual": float(np.sqrt(squared.mean())) if len(squared) else 0.0,
    }


def _integrate_large(
    normals: np.ndarray, mask: np.ndarray, camera: Camera, sharpness: float, most: int, started: float
) -> Depth:
    """Do what `integrate` does on the grid itself; `sharpness` 0 for a surface without jumps."""
    box = tuple(slice(int(at[0]), int(at[-1]) + 1) for at in (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)))
    inside = np.ascontiguousarray(mask[box])
    slopes, below = _slopes(normals, mask, box, camera)
    edges = Edges(*(np.zeros(inside.shape, np.float32) for _ in Edges._fields))
    z, iterations = np.zeros(inside.shape), 1
    smooth_edges(slopes, inside, edges)
    right, weights = right_side(edges), (edges.across, edges.down)
    del edges  # half of it is not needed any more
    with share(0.0, 0.3 if sharpness else 1.0):
        cycle = Cycle(*weights, inside)
        solve_grid(cycle, right, z, tolerance=_TOLERANCE, tell=lambda done: stage("depth", done))
        del cycle, right
    if sharpness:
        del weights
        with share(0.3, 1.0):
            iterations, weights = _reweight(slopes, inside, z, sharpness, most)
    laid = _lay_out_large(slopes, inside, z, weights, mask.shape, box, camera)
    return Depth(
        mask=mask, below=below, iterations=iterations, **laid, seconds=time.perf_counter() - started, camera=camera
    )


def _lay_out_large(
    slopes: Slopes,
    inside: np.ndarray,
    z: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray],
    shape: tuple[int, int],
    box: tuple[slice, ...],
    camera: Camera,
) -> dict[str, Any]:
    """Do what `_lay_out` does, and tell the share of torn edges."""
    found, components = ndimage.label(inside)
    labels, depth, residuals = np.full(shape, -1, np.int32), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    labels[box] = found - 1
    numbers, heights = found[inside], z[inside]
    sums, counts = np.bincount(numbers, heights), np.bincount(numbers)
    depth[box][inside] = camera.height(heights - (sums / np.maximum(counts, 1))[numbers])
    rows, angles = np.zeros((len(inside), 3)), np.zeros(inside.shape, np.float32)
    measure(slopes, inside, z, weights[0], weights[1], angles, rows)
    residuals[box] = angles
    squares, count, torn = rows.sum(axis=0)
    return {
        "z": depth, "labels": labels, "components": int(components), "residuals": residuals,
        "residual": float(np.sqrt(squares / max(count, 1))), "torn": float(torn / max(count, 1)),
    }  # fmt: skip


def _slopes(normals: np.ndarray, mask: np.ndarray, box: tuple[slice, ...], camera: Camera) -> tuple[Slopes, float]:
    """Return unit normals of the box, a few rows at a time, and the share that faces the camera too little."""
    shape = mask[box].shape
    slopes = Slopes(*(np.zeros(shape, np.float32) for _ in Slopes._fields))
    flat = 0
    step = max(1, _BAND // shape[1])
    for start in range(0, shape[0], step):
        rows = slice(box[0].start + start, min(box[0].start + start + step, box[0].stop))
        inside = mask[rows, box[1]]
        if not inside.any():
            continue
        unit = check_normals(normals[rows, box[1]], inside)
        facing = _facing(unit, inside, camera.crop(mask.shape, rows.start, box[1].start))
        flat += int((facing < STEEPEST).sum())
        for part, values in zip(slopes, (unit[:, 0], unit[:, 1], np.maximum(facing, STEEPEST)), strict=True):
            part[start : start + step][inside] = values
    return slopes, flat / int(mask.sum())


def _reweight(
    slopes: Slopes, inside: np.ndarray, z: np.ndarray, sharpness: float, most: int
) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
    """Reweight the one-sided equations as `_bilateral` does, z (h, w) in place.

    Returns:
        The systems solved, and the weights of the edges.
    """
    edges = Edges(*(np.zeros(inside.shape, np.float32) for _ in Edges._fields))
    energy, rows = np.inf, np.zeros(len(inside))
    for number in range(most):
        bilateral_edges(slopes, inside, z, sharpness, _WEAKEST, edges, rows)
        last, energy = energy, float(rows.sum())
        if number and abs(last - energy) <= _SETTLED * energy:
            return number + 1, (edges.across, edges.down)
        solve_grid(Cycle(edges.across, edges.down, inside), right_side(edges), z, tolerance=_ROUGH)
        stage("depth", number + 1, most)
    return most + 1, (edges.across, edges.down)
