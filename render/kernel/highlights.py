"""Narrow highlights, sampled from the lights' side: points whose normal is near the half vector.

The highlight of a mirror-like metal covers a few tenths of a degree of normals, a pixel of a curved object several
degrees, so that thousands of samples per pixel would be needed to meet it. Under distant lights and an orthographic
camera each light has one half vector h. Normals drawn around h are mapped back to the surface: on a triangle with
corner normals N = [n0 n1 n2] the normal m is found at the barycentric coordinates N^-1 m, normalised to sum 1. Near
lights and perspective have another h everywhere; that of a triangle's centroid then stands for the triangle. Where the
triangle is small, as seen from light and camera, h hardly turns on it; the larger it is, the less the noise shrinks.

Both strategies, samples over the pixel's area and normals around h, are combined by the balance heuristic (Veach 1997,
eq. 9.8): with p the density of the second over image area, every sample of either counts f V / (spp + A p), A the area
of the pixel. So nothing is biased, for any material.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import opaque, upload
from render.backend.jit import dr, mi
from render.backend.sampling import scramble, stream, uniform

_NORMALS_PER_SAMPLE, _FEWEST, _MOST = 8, 256, 2048
# s = 1 - cos(theta) around h is drawn with density ~ (1 + s / _CORE)^(-3/2) up to _RIM, which falls with the cube of
# the angle from a tenth of a degree on, as the peaks of mirror-like metals do.
_CORE = 1 - math.cos(math.radians(0.1))
_RIM = 1 - math.cos(math.radians(4.0))
_TAIL = 1 - (1 + _RIM / _CORE) ** -0.5
_LANES_AT_ONCE = 1 << 22  # bounds the memory
_FLAT, _SLIVER = 2e-9, 1e-3  # determinants of the corner normals, absolute and relative, too small for float32


class Glints(NamedTuple):
    """Points with a normal near a half vector, seen by the camera and by the light; G of them."""

    normal: Any  # Vector3f (G), shading normal, object frame
    light: Any  # UInt32 (G)
    target: np.ndarray  # (G,) int64, light * pixels + pixel
    factor: Any  # Float (G), weight in units of a camera sample
    weights: tuple  # as `Vertices.weights`
    wi: Any  # Vector3f (G, or 1), to the camera
    wo: Any  # Vector3f (G), to the light
    strength: Any  # Float (G, or 1), irradiance / pi


class SharedHalves(NamedTuple):
    """The half vectors of distant lights and an orthographic camera."""

    halves: Any  # Vector3f (L)

    def of(self, light: Any, _centre: Any) -> Any:
        """Return the half vectors of lights on triangles with the given centroids."""
        return dr.gather(mi.Vector3f, self.halves, light)


class LocalHalves(NamedTuple):
    """The half vectors of near lights, or of a perspective camera."""

    camera: Any
    emitters: Any

    def of(self, light: Any, centre: Any) -> Any:
        """Return the half vectors of lights on triangles with the given centroids."""
        return dr.normalize(self.camera.towards(centre) + self.emitters.towards(light, centre)[0])


def half_vectors(camera: Any, emitters: Any, parallel: bool) -> SharedHalves | LocalHalves:
    """Return the half vectors that normals are drawn around.

    Args:
        camera: A `render.kernel.camera.Camera`.
        emitters: The lights (`render.kernel.emitters`).
        parallel: Whether both are distant.
    """
    if not parallel:
        return LocalHalves(camera, emitters)
    towards = camera.to_object(0, 0, 1)
    halves = dr.normalize(emitters.directions + towards)
    dr.eval(halves)
    return SharedHalves(halves)


def centroid(corners: Any) -> Any:
    """Return the centroids of `render.kernel.scene.Triangles`."""
    p0, p1, p2 = corners.positions
    return mi.Point3f((p0 + p1 + p2) * (1 / 3))


def normals(spp: int) -> int:
    """Return how many normals are drawn for a light, per point that mirrors it, in addition to `spp` samples."""
    return min(max(_NORMALS_PER_SAMPLE * spp, _FEWEST), _MOST)


def density(s: Any) -> Any:
    """Return the density per solid angle of the drawn normals at s = 1 - cos(theta) from h."""
    falloff = dr.rsqrt(1 + s * (1 / _CORE))
    return dr.select(s < _RIM, dr.square(falloff) * falloff * (1 / (4 * math.pi * _CORE * _TAIL)), 0)


def partition(spread: Any, s: Any, size: int, spp: int) -> Any:
    """Return the weight of a sample, of either strategy, in units of a camera sample: spp / (spp + A p).

    Args:
        spread: d(solid angle of normals) / d(image area) there.
        s: 1 - cos(theta_h).
        size: Image side in pixels.
        spp: Camera samples per pixel.
    """
    ratio = opaque(mi.Float(normals(spp) / spp * (2 / size) ** 2))
    return dr.rcp(dr.fma(ratio * spread, density(s), 1))


def one_minus_cos(normal: Any, half: Any) -> Any:
    """Return 1 - cos of the angle between unit vectors, exact for small angles."""
    sin2 = dr.squared_norm(dr.cross(normal, half))
    return sin2 / (1 + dr.maximum(dr.dot(normal, half), 0))


def normal_spread(scene: Any, camera: Any, prim: Any, uv: Any) -> tuple:
    """Return the centroids of the triangles that were hit, and d(solid angle of the shading normal) / d(image area).

    The latter is zero where triangles are flat.

    Args:
        scene: A `render.kernel.scene.Scene`.
        camera: A `render.kernel.paths.Camera`.
        prim: (N) triangle numbers.
        uv: (N) barycentric coordinates of corners 1 and 2.
    """
    corners = scene.triangles(prim)
    centre, spread = centroid(corners), _solid_angle_ratio(corners, uv.x, uv.y, camera)
    dr.eval(centre, spread)
    return centre, spread


def find(
    scene: Any, camera: Any, emitters: Any, halves: Any, lights: int, surfaces: Any, spp: int, seed: int, first: int
) -> Glints | None:
    """Find the points on the visible, lit surface whose normals were drawn around the half vectors.

    Args:
        scene: A `render.kernel.scene.Scene`.
        camera: A `render.kernel.paths.Camera`.
        emitters: The lights (`render.kernel.emitters`).
        halves: Of `half_vectors`.
        lights: Number of lights, L.
        surfaces: The surfaces, whose patterns are evaluated at the points.
        spp: Camera samples per pixel of the pass.
        seed, first: Seed and first sample of the pass.

    Returns:
        The points, or None when no light is mirrored anywhere.
    """
    candidates = _candidates(scene, camera, halves, lights, normals(spp))
    if candidates is None:
        return None
    found = []
    for chosen in _chunks(candidates):
        drawn = _draw(scene, camera, halves, candidates, chosen, normals(spp), stream(seed, 77 + first))
        seen = drawn and _keep_visible(scene, camera, emitters, drawn, spp)
        if seen:
            found.append(seen)
    if not found:
        return None
    # Joined by NumPy: the number of chunks would be in Dr.Jit's code.
    joined = [np.concatenate(values) for values in zip(*found, strict=True)]
    x, y, light = joined[:3]
    half, last = camera.size / 2, camera.size - 1
    # A coordinate just below 1 may round up to the edge.
    column, row = (np.minimum(((value + 1) * half).astype(np.int64), last) for value in (x, -y))
    target = light.astype(np.int64) * camera.size**2 + row * camera.size + column
    prim, light = upload(mi.UInt32, joined[3]), upload(mi.UInt32, light)
    floats = [upload(mi.Float, values) for values in joined[4:]]
    point, normal, factor = mi.Point3f(*floats[:3]), mi.Vector3f(*floats[3:6]), floats[6]
    towards, (wo, strength) = camera.towards(point), emitters.towards(light, point)
    dr.eval(towards, wo, strength)
    return Glints(normal, light, target, factor, surfaces.weights(point, prim), towards, wo, strength)


def _keep_visible(scene: Any, camera: Any, emitters: Any, drawn: tuple, spp: int) -> list | None:
    """Keep the points inside the frame that the camera and their light see.

    Returns:
        Image coordinates x and y, light, triangle, point (3), normal (3) and weight as NumPy arrays.
    """
    point, normal, facet, prim, light, spread, s = drawn
    start = dr.zeros(mi.SurfaceInteraction3f, dr.width(prim))
    start.p, start.n = point, mi.Normal3f(facet)
    direction, ray = emitters.shadow_ray(start, light)
    x, y = camera.project(point)
    seen = (dr.abs(x) < 1) & (dr.abs(y) < 1) & (dr.dot(normal, direction) > 0) & (spread > 0)
    seen &= ~scene.ray_test(start.spawn_ray(camera.towards(point)), False, seen)
    seen &= ~scene.ray_test(ray, False, seen)
    factor = partition(spread, s, camera.size, spp)
    dr.eval(seen, x, y, factor)
    kept = dr.compress(seen)
    if len(kept) == 0:
        return None
    point = mi.Vector3f(point)
    values = (x, y, light, prim, point.x, point.y, point.z, normal.x, normal.y, normal.z, factor)
    gathered = [dr.gather(type(value), value, kept) for value in values]
    dr.eval(gathered)
    return [np.array(value) for value in gathered]


class _Candidates(NamedTuple):
    """Pairs of a triangle and a light whose half vector its normals come near; C of them."""

    triangle: Any  # UInt32 (C)
    light: Any  # UInt32 (C)
    begin: np.ndarray  # (C,) first of the light's normals that the triangle may have
    end: np.ndarray  # (C,) one past the last


def _candidates(scene: Any, camera: Any, halves: Any, lights: int, count: int) -> _Candidates | None:
    """Find, by the bounding cone of each triangle's normals, which of a light's drawn normals it may have.

    The normals of a light are numbered by their distance from the half vector, so these are a run.
    """
    corners = scene.triangles(dr.arange(mi.UInt32, len(scene.mesh.faces)))
    axis = dr.normalize(corners.normals[0] + corners.normals[1] + corners.normals[2])
    cosines = [dr.dot(axis, normal) for normal in corners.normals]
    cosine = dr.clip(dr.minimum(dr.minimum(cosines[0], cosines[1]), cosines[2]), 0, 1)
    cone = dr.acos(cosine) + 1e-4  # radians; slack for the rounding of acos
    facing = mi.Bool(False)  # elsewhere the shading normal turns away from the camera, and the surface is black
    for position, normal in zip(corners.positions, corners.normals, strict=True):
        facing |= dr.dot(normal, camera.towards(position)) > 0
    centre = centroid(corners)
    dr.eval(axis, cone, facing, centre)
    shown = dr.compress(facing)
    if len(shown) == 0:
        return None
    axis, cone = dr.gather(mi.Vector3f, axis, shown), dr.gather(mi.Float, cone, shown)
    centre = dr.gather(mi.Point3f, centre, shown)
    reach = dr.cos(dr.minimum(cone + math.acos(1 - _RIM), math.pi))
    dr.eval(axis, cone, reach)
    width = opaque(mi.UInt32(len(shown)))
    lane = dr.arange(mi.UInt32, len(shown) * lights)
    light = lane // width
    local = lane - light * width
    near = dr.dot(dr.gather(mi.Vector3f, axis, local), halves.of(light, dr.gather(mi.Point3f, centre, local)))
    kept = dr.compress(near > dr.gather(mi.Float, reach, local))
    if len(kept) == 0:
        return None
    light = kept // width
    local = kept - light * width
    half, axis = halves.of(light, dr.gather(mi.Point3f, centre, local)), dr.gather(mi.Vector3f, axis, local)
    away = 2 * dr.asin(dr.minimum(dr.norm(axis - half) * 0.5, 1))  # exact for small angles, unlike acos
    cone = dr.gather(mi.Float, cone, local)
    ends = [_share(1 - dr.cos(angle)) for angle in (dr.maximum(away - cone, 0), dr.minimum(away + cone, math.pi))]
    triangle = dr.gather(mi.UInt32, shown, local)
    dr.eval(triangle, light, ends)
    begin, end = (count * np.array(value, np.float64) for value in ends)
    return _Candidates(
        triangle, light, np.maximum(np.floor(begin) - 1, 0).astype(np.int64),
        np.minimum(np.ceil(end) + 1, count).astype(np.int64),
    )  # fmt: skip


def _share(s: Any) -> Any:
    """Return the share of a light's normals within s = 1 - cos(theta) of its half vector."""
    return (1 - dr.rsqrt(1 + dr.minimum(s, _RIM) * (1 / _CORE))) * (1 / _TAIL)


def _chunks(candidates: _Candidates) -> Iterator[tuple]:
    """Yield (pair, normal) numbers of all that is to be tried, as UInt32 arrays of bounded length."""
    counts = candidates.end - candidates.begin
    total = np.cumsum(counts)
    pair = 0
    while pair < len(counts):
        done = total[pair - 1] if pair else 0
        stop = max(pair + 1, int(np.searchsorted(total, done + _LANES_AT_ONCE)))
        part = np.arange(pair, stop)
        pairs = np.repeat(part, counts[pair:stop])
        first = candidates.begin[pair:stop] - (total[pair:stop] - counts[pair:stop]) + done
        first = np.repeat(first, counts[pair:stop])
        pair = stop
        if len(pairs) > 1:
            numbers = first + np.arange(len(pairs))
            yield tuple(upload(mi.UInt32, values.astype(np.uint32)) for values in (pairs, numbers))


def _draw(
    scene: Any, camera: Any, halves: Any, candidates: _Candidates, chosen: tuple, count: int, seed: Any
) -> tuple | None:
    """Draw normals around half vectors; return those that their triangle has, and where.

    A light's normals are a rotated Hammersley set of its own for every triangle.
    """
    pair, number = chosen
    prim, light = dr.gather(mi.UInt32, candidates.triangle, pair), dr.gather(mi.UInt32, candidates.light, pair)
    half = halves.of(light, centroid(scene.triangles(prim)))
    turn = scramble(prim * mi.UInt32(0x9E3779B1) + light, seed)
    u = (mi.Float(number) + uniform(turn[0])) * opaque(mi.Float(1 / count))
    s = _CORE * (dr.rcp(dr.square(1 - u * _TAIL)) - 1)
    sine = dr.sqrt(dr.maximum(s * (2 - s), 0))
    sin_phi, cos_phi = dr.sincos(dr.two_pi * mi.radical_inverse_2(number, turn[1]))
    normal = mi.Frame3f(half).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 1 - s))
    # Differences, since the triple product of three nearly parallel normals would lose all digits in float32: m is
    # parallel to n0 + b1 e1 + b2 e2 for these b.
    n0, e1, e2 = _edges(scene.triangles(prim).normals)
    turned = dr.cross(n0, normal - n0)
    scale = dr.rcp(dr.dot(normal, dr.cross(e1, e2)))
    b1, b2 = dr.dot(e2, turned) * scale, -dr.dot(e1, turned) * scale
    inside = (b1 >= 0) & (b2 >= 0) & (b1 + b2 <= 1)
    dr.eval(inside, normal, b1, b2, s, prim, light)
    kept = dr.compress(inside)
    if len(kept) < 2:  # a single one would compile kernels of its own, and is not worth it
        return None
    normal = dr.gather(mi.Vector3f, normal, kept)
    b1, b2, s = (dr.gather(mi.Float, value, kept) for value in (b1, b2, s))
    prim, light = (dr.gather(mi.UInt32, value, kept) for value in (prim, light))
    corners = scene.triangles(prim)
    p0, p1, p2 = corners.positions
    point = p0 + b1 * (p1 - p0) + b2 * (p2 - p0)
    facet = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    spread = _solid_angle_ratio(corners, b1, b2, camera)
    dr.eval(point, normal, facet, prim, light, spread, s)
    return point, normal, facet, prim, light, spread, s


def _edges(normals: tuple) -> tuple:
    """Return the first corner normal and the differences of the others from it."""
    return normals[0], normals[1] - normals[0], normals[2] - normals[0]


def _solid_angle_ratio(corners: Any, b1: Any, b2: Any, camera: Any) -> Any:
    """Return d(solid angle) / d(image area) at barycentric coordinates of corners 1 and 2; zero where it is unsafe.

    With m = N b / |N b| the solid angle is |det N| / |N b|^3 per unit of barycentric area, and the image area is the
    projected area of the triangle, twice, per the same unit.
    """
    n0, e1, e2 = _edges(corners.normals)
    p0, p1, p2 = corners.positions
    determinant = dr.abs(dr.dot(n0, dr.cross(e1, e2)))
    area = camera.image_area(dr.cross(p1 - p0, p2 - p0), p0 + b1 * (p1 - p0) + b2 * (p2 - p0))
    length2 = dr.squared_norm(n0 + b1 * e1 + b2 * e2)
    longest2 = dr.maximum(dr.squared_norm(e1), dr.squared_norm(e2))
    usable = (determinant > _FLAT) & (determinant > _SLIVER * longest2) & (area > 1e-12) & (length2 > 1e-6)
    return dr.select(usable, determinant / (length2 * dr.sqrt(length2) * area), 0)
