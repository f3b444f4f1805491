"""Shadows and light between the parts of an object, traced over the surface that its normals integrate to.

The surface is a height field z(x, y) over the pixels, seen from above; everything under it is solid. What a pinhole
sees is one as well, of s = z / (1 - z / f), which keeps straight lines straight: a ray that leaves X in the direction l
goes along l + (x, y, s) l_z / f there. Pixel p, image i; n unit normal, l unit direction to the light, V whether two
points see each other, A a pixel's area on the surface:

    lit_pi  = 1 where the ray from p towards l_pi stays above the surface
    F_pq    = V_pq max(n_p . w, 0) max(-n_q . w, 0) A_q / (pi r^2)          w, r direction and distance from p to q
    B       = rho E + rho F (rho E) + ...,   E_pi = lit_pi max(n_p . l_pi, 0) falloff_pi   radiosity; light pi
    bounced = B - rho E

(Goral et al., Modeling the interaction of light between diffuse surfaces, SIGGRAPH 1984). The renderer traces the same
on meshes of any shape (`render.kernel`); tests compare both.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from sdps.core.geometry import ORTHOGRAPHIC, Camera

_OFFSET = 0.3
"""Rays start this many pixels above the surface, since its slopes are not exact."""
_LEAST_COSINE = np.float32(0.02)
_LEAST_PACE = np.float32(1e-4)
_ADJACENT = np.float32(1.44)  # squared distance of neighbours, which do not see each other
_STEEPEST = 0.15  # n_z, for the areas
_ONE = np.float32(1.0)


class Transport(NamedTuple):
    """How light travels between P pixels of a surface under L lights.

    Attributes:
        lit: (P, L) bool, whether nothing blocks the light; true also where the pixel faces away.
        factors: (P, P) float32, F; rows sum to at most 1.
    """

    lit: np.ndarray
    factors: np.ndarray

    def bounce(self, shade: np.ndarray, albedo: np.ndarray, bounces: int = 2) -> np.ndarray:
        """Return the radiance (P, 3, L) float32 of bounced light.

        Args:
            shade: (P, L) n . l falloff.
            albedo: (P, 3), 1 for a white Lambertian surface.
            bounces: How often light is reflected after its first reflection.
        """
        direct = np.where(self.lit, np.maximum(shade, 0.0), 0.0).astype(np.float32)  # (P, L)
        found = np.empty((len(shade), 3, shade.shape[1]), np.float32)
        for channel in range(3):
            rho = albedo[:, channel : channel + 1].astype(np.float32)
            leaving = rho * direct
            total = np.zeros_like(leaving)
            for _ in range(bounces):
                leaving = rho * (self.factors @ leaving)
                total += leaving
            found[:, channel] = total
        return found


def trace(
    heights: np.ndarray, mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, camera: Camera = ORTHOGRAPHIC
) -> Transport:
    """Trace cast shadows and which pixels see each other.

    Args:
        heights: (H, W), towards the camera, in pixels; not read outside the mask.
        mask: (H, W) bool, P true.
        normals: (P, 3) unit.
        lights: (L, 3) unit directions from the surface to the light, or (P, L, 3), those of each pixel.
        camera: Of this picture.
    """
    unit = np.ascontiguousarray(normals, np.float32)
    field, points, above, ways = _lay(heights, mask, unit, lights, camera)
    factors = np.zeros((len(points), len(points)), np.float32)
    area = (1.0 / np.maximum(unit[:, 2], _STEEPEST)).astype(np.float32)
    _form_factors(field, points, above, unit, area, factors)
    factors /= np.maximum(factors.sum(axis=1, keepdims=True), 1.0)
    return Transport(_find_lit(field, above, ways), factors)


def trace_shadows(
    heights: np.ndarray, mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, camera: Camera = ORTHOGRAPHIC
) -> np.ndarray:
    """Return which pixels nothing blocks the light of, (P, L) bool; arguments of `trace`."""
    field, _, above, ways = _lay(heights, mask, np.ascontiguousarray(normals, np.float32), lights, camera)
    return _find_lit(field, above, ways)


def _find_lit(field: np.ndarray, above: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return which rays (P, L, 3) from points (P, 3) leave the height field (H, W), (P, L) bool."""
    lit = np.ones(ways.shape[:2], np.bool_)
    _shadows(field, above, np.ascontiguousarray(ways), lit)
    return lit


def _lay(
    heights: np.ndarray, mask: np.ndarray, unit: np.ndarray, lights: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a height field (H, W), its points (P, 3), where rays begin (P, 3) and their ways (P, L, 3)."""
    field = np.where(mask, heights, -np.inf).astype(np.float32)
    rows, columns = (places.astype(np.float32) for places in np.nonzero(mask))
    points = np.stack([columns, -rows, field[mask]], axis=1)
    lights = np.asarray(lights, np.float32)
    ways = np.broadcast_to(lights, (len(points), *lights.shape[-2:]))
    above = points + np.float32(_OFFSET) * unit
    if camera.is_perspective:
        points = camera.positions(np.where(mask, heights, 0.0))[mask].astype(np.float32)
        field, above, ways = _straighten(field, mask, points + np.float32(_OFFSET) * unit, ways, camera)
    return field, points, above, ways


def _straighten(
    field: np.ndarray, mask: np.ndarray, above: np.ndarray, ways: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights s, points above the surface and ways of rays where what a pinhole sees is a height field.

    Args:
        field: (H, W) z, -inf outside the mask.
        mask: (H, W) bool.
        above: (P, 3) positions.
        ways: (P, L, 3) directions.
        camera: The pinhole.
    """
    focal, (column, row) = np.float32(camera.focal), camera.middle(mask.shape)
    finite = np.where(mask, field, 0.0)
    nearer = np.where(mask, finite / (1 - finite / focal), -np.inf).astype(np.float32)
    seen = above / (1 - above[:, 2:] / focal)
    straight = ways + seen[:, None] * (ways[..., 2:] / focal)
    return nearer, (seen + np.array([column, -row, 0.0])).astype(np.float32), straight.astype(np.float32)


@numba.njit(cache=True)
def _height(field: np.ndarray, row: Any, column: Any) -> Any:
    """Return the height between four pixels, bilinear; -inf outside the object, where nothing blocks."""
    r, c = min(int(row), field.shape[0] - 2), min(int(column), field.shape[1] - 2)
    down, right = row - r, column - c
    upper = field[r, c] * (_ONE - right) + field[r, c + 1] * right
    lower = field[r + 1, c] * (_ONE - right) + field[r + 1, c + 1] * right
    return upper * (_ONE - down) + lower * down


@numba.njit(cache=True)
def _is_blocked(field: np.ndarray, start: Any, way: Any, steps: int) -> bool:
    """Return whether the surface rises above one of the `steps` - 1 points reached from `start` in steps of `way`."""
    x, y, z = start
    for _ in range(1, steps):
        x, y, z = x + way[0], y + way[1], z + way[2]
        if -y < 0 or x < 0 or -y > field.shape[0] - 1 or x > field.shape[1] - 1:
            return False
        if _height(field, -y, x) > z:
            return True
    return False


@numba.njit(parallel=True, cache=True)
def _shadows(field: np.ndarray, points: np.ndarray, lights: np.ndarray, lit: np.ndarray) -> None:
    top = field.max()
    for p in numba.prange(len(points)):
        start = (points[p, 0], points[p, 1], points[p, 2])
        for i in range(lights.shape[1]):
            x, y, z = lights[p, i]
            pace = max(abs(x), abs(y), _LEAST_PACE)  # so that a step is a pixel long
            way = (x / pace, y / pace, z / pace)
            steps = field.shape[0] + field.shape[1]
            if way[2] > 0:
                steps = min(steps, int((top - start[2]) / way[2]) + 2)
            lit[p, i] = not _is_blocked(field, start, way, steps)


@numba.njit(parallel=True, cache=True)
def _form_factors(
    field: np.ndarray, points: np.ndarray, above: np.ndarray, normals: np.ndarray, area: np.ndarray, factors: np.ndarray
) -> None:
    for p in numba.prange(len(points)):
        start = (above[p, 0], above[p, 1], above[p, 2])
        for q in range(len(points)):
            dx, dy, dz = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1], points[q, 2] - points[p, 2]
            squared = dx * dx + dy * dy + dz * dz
            leaves = dx * normals[p, 0] + dy * normals[p, 1] + dz * normals[p, 2]
            arrives = -(dx * normals[q, 0] + dy * normals[q, 1] + dz * normals[q, 2])
            least = _LEAST_COSINE * np.sqrt(squared)
            if squared < _ADJACENT or leaves < least or arrives < least:
                continue
            steps = max(int(max(abs(dx), abs(dy))), 1)
            tx, ty, tz = above[q, 0] - start[0], above[q, 1] - start[1], above[q, 2] - start[2]
            if not _is_blocked(field, start, (tx / steps, ty / steps, tz / steps), steps):
                factors[p, q] = leaves * arrives * area[q] / (np.pi * squared * max(squared, area[q] / np.pi))
