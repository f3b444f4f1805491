"""Shadow rays of all lights, one bit each, as few as the picture needs.

At the camera's hits neighbouring samples of a pixel mostly see the same lights. So the first samples of a pixel, spread
evenly over it, probe every light. Where all of them agree that a light is seen, or that it is not, the others follow;
where they differ, or none of them faces the light, every sample asks for itself. In compositions half of the paths go
on, and vertices behind the camera's hits share in the same way what others near them see.
"""

from typing import Any

import numpy as np

from render.backend.arrays import opaque, upload
from render.backend.jit import dr, mi

WORD = 32  # lights per entry of a bitmask
_LEAST_PROBES = 8
_PROBED = 4  # one sample in so many probes, where there are more than the least
_CELL = 0.08  # side of the cells whose vertices share, in radii of the object's bounding sphere
_SHUFFLE = np.uint64(2654435761)  # odd, so that multiples of the first 2^24 numbers differ below 2^24


def probe_count(spp: int) -> int:
    """Return how many of a pixel's `spp` samples probe every light: all up to 8, then 8, then a quarter."""
    if spp <= _LEAST_PROBES:
        return spp
    wanted = max(_LEAST_PROBES, spp // _PROBED)
    return 1 << (wanted - 1).bit_length()  # a power of two, so that the probes are stratified


def visibility(scene: Any, position: Any, normal: Any, facet: Any, emitters: Any, lights: int, coherent: bool) -> Any:
    """Cast one shadow ray per vertex and light it faces.

    Args:
        scene: What casts shadows.
        position: (N) Point3f.
        normal: (N) shading normals; a light below their horizon needs no ray.
        facet: (N) geometric normals, along which rays start off the surface.
        emitters: The lights (`render.kernel.emitters`).
        lights: L.
        coherent: Whether neighbouring vertices are close to each other.

    Returns:
        The visibility bitmask, UInt32 (ceil(L / 32) * N): bit b of entry `w * N + i` says whether vertex i sees light
        32 w + b.
    """
    return _cast(scene, position, normal, facet, emitters, lights, coherent)[0]


def probe_visibility(
    scene: Any, position: Any, normal: Any, facet: Any, emitters: Any, lights: int, probes: Any, segments: tuple
) -> Any:
    """Do the same at the camera's hits, sorted by pixel, asking every light only where the probes disagree.

    Args:
        scene, position, normal, facet, emitters, lights: As in `visibility`.
        probes: (N) Bool, the samples that probe.
        segments: (start, length) UInt32 (Q) of the pixels' runs of vertices.
    """
    count = dr.width(position)
    tested = dr.compress(probes)
    if len(tested) == 0 or len(tested) == count:
        return visibility(scene, position, normal, facet, emitters, lights, True)
    at = tuple(dr.gather(type(value), value, tested) for value in (position, normal, facet))
    lit, facing = _cast(scene, at[0], at[1], at[2], emitters, lights, True)
    groups, total = -(-lights // WORD), opaque(mi.UInt32(count))
    bitmask = dr.zeros(mi.UInt32, count * groups)
    lane = dr.arange(mi.UInt32, len(tested) * groups)
    width = opaque(mi.UInt32(len(tested)))
    group = lane // width
    target = dr.fma(group, total, dr.gather(mi.UInt32, tested, lane - group * width))
    known = dr.zeros(mi.UInt32, count * groups)  # facing bits of the probes
    dr.scatter(bitmask, lit, target)
    dr.scatter(known, facing, target)
    dr.eval(bitmask, known)
    agreed = _agreement(bitmask, known, segments, total, groups)
    return _complete(scene, (position, normal, facet), emitters, bitmask, probes, agreed, segments, lights)


def group_visibility(
    scene: Any, positions: np.ndarray, normals: np.ndarray, facets: np.ndarray, emitters: Any, lights: int
) -> Any:
    """Do the same at vertices in any order, of which those share that lie in one cell and face one way.

    Args:
        scene, emitters, lights: As in `visibility`.
        positions: (3, N) float32, in the unit sphere.
        normals: (3, N) float32, shading normals.
        facets: (3, N) float32, geometric normals.
    """
    count, groups = positions.shape[1], -(-lights // WORD)
    order, (start, length) = cells(positions, facets)
    rank = (np.arange(count) - np.repeat(start, length)).astype(np.uint32)
    place = np.empty(count, np.uint32)
    place[order] = np.arange(count, dtype=np.uint32)
    position, normal, facet = (
        mi.Vector3f(*(upload(mi.Float, row[order]) for row in rows)) for rows in (positions, normals, facets)
    )
    probes = upload(mi.UInt32, rank) < _LEAST_PROBES
    segments = upload(mi.UInt32, start.astype(np.uint32)), upload(mi.UInt32, length.astype(np.uint32))
    bits = probe_visibility(scene, mi.Point3f(position), normal, facet, emitters, lights, probes, segments)
    width, lane = opaque(mi.UInt32(count)), dr.arange(mi.UInt32, count * groups)
    word = lane // width * width
    bitmask = dr.gather(mi.UInt32, bits, word + dr.gather(mi.UInt32, upload(mi.UInt32, place), lane - word))
    dr.eval(bitmask)
    return bitmask


def cells(positions: np.ndarray, facets: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Sort vertices (3, N) by the cell they lie in and the axis they face, in random order within.

    Returns:
        The order (N,) uint32, and (start, length) of each run.
    """
    count = positions.shape[1]
    column, row, layer = np.floor((np.clip(positions, -1.5, 1.5) + 1.5) / _CELL).astype(np.uint64)
    axis = np.abs(facets).argmax(0)
    side = 2 * axis.astype(np.uint64) + (np.take_along_axis(facets, axis[None], 0)[0] > 0)
    cell = ((column << np.uint64(20) | row << np.uint64(10) | layer) << np.uint64(3)) | side
    order = np.lexsort((np.arange(count, dtype=np.uint64) * _SHUFFLE % np.uint64(1 << 24), cell))
    cell = cell[order]
    start = np.flatnonzero(np.concatenate([[True], cell[1:] != cell[:-1]]))
    return order.astype(np.uint32), (start, np.diff(start, append=count))


def _cast(scene: Any, position: Any, normal: Any, facet: Any, emitters: Any, lights: int, coherent: bool) -> tuple:
    """Return the bitmasks of lights seen, and of lights faced."""
    count, groups = dr.width(position), -(-lights // WORD)
    width, total = opaque(mi.UInt32(count)), opaque(mi.UInt32(lights))
    lane = dr.arange(mi.UInt32, count * groups)
    first = lane // width * WORD
    start, shading = _start(position, normal, facet, lane - first // WORD * width)

    def per_light(b: Any, seen: Any, faced: Any) -> tuple:
        direction, ray = emitters.shadow_ray(start, first + b)
        facing = dr.dot(shading, direction) > 0
        lit = facing & ~scene.ray_test(ray, coherent, facing)
        return b + 1, seen | (mi.UInt32(lit) << b), faced | (mi.UInt32(facing) << b)

    state = (mi.UInt32(0), mi.UInt32(0), mi.UInt32(0))
    _, seen, faced = dr.while_loop(state, lambda b, *_: (b < WORD) & (first + b < total), per_light)
    dr.eval(seen, faced)
    return seen, faced


def _agreement(bitmask: Any, faced: Any, segments: tuple, count: Any, groups: int) -> tuple:
    """Return, per pixel, the bitmasks of lights that all facing probes see, and that none of them sees (groups * Q)."""
    start, length = segments
    width = opaque(mi.UInt32(dr.width(start)))
    lane = dr.arange(mi.UInt32, dr.width(start) * groups)
    group = lane // width
    pixel = lane - group * width
    first, number = dr.gather(mi.UInt32, start, pixel), dr.gather(mi.UInt32, length, pixel)

    def per_vertex(i: Any, some: Any, missing: Any) -> tuple:
        at = dr.fma(group, count, first + i)
        lit, facing = dr.gather(mi.UInt32, bitmask, at), dr.gather(mi.UInt32, faced, at)
        return i + 1, some | lit, missing | (facing & ~lit)

    state = (mi.UInt32(0), mi.UInt32(0), mi.UInt32(0))
    _, some, missing = dr.while_loop(state, lambda i, *_: i < number, per_vertex)
    seen, hidden = some & ~missing, missing & ~some
    dr.eval(seen, hidden)
    return seen, hidden


def _complete(
    scene: Any, at: tuple, emitters: Any, bitmask: Any, probes: Any, agreed: tuple, segments: tuple, lights: int
) -> Any:
    """Fill in the bitmask of the other vertices: what their pixel agrees on, and rays for the rest."""
    count, groups = dr.width(probes), -(-lights // WORD)
    others = dr.compress(~probes)
    pixel = _pixel_of_vertex(segments, count)
    width, total = opaque(mi.UInt32(len(others))), opaque(mi.UInt32(lights))
    pixels = opaque(mi.UInt32(dr.width(segments[0])))
    lane = dr.arange(mi.UInt32, len(others) * groups)
    group = lane // width
    vertex = dr.gather(mi.UInt32, others, lane - group * width)
    entry = dr.fma(group, pixels, dr.gather(mi.UInt32, pixel, vertex))
    seen, hidden = (dr.gather(mi.UInt32, bits, entry) for bits in agreed)
    remaining = dr.minimum(total - group * WORD, WORD)
    used = dr.select(remaining == WORD, mi.UInt32(0xFFFFFFFF), (mi.UInt32(1) << remaining) - 1)
    asked, target = ~(seen | hidden) & used, dr.fma(group, opaque(mi.UInt32(count)), vertex)
    dr.scatter(bitmask, seen, target)
    dr.eval(bitmask, asked, target, group, vertex)
    kept = dr.compress(asked != 0)
    if len(kept) == 0:
        return bitmask
    asked, target, first, vertex = (dr.gather(mi.UInt32, value, kept) for value in (asked, target, group, vertex))
    first *= WORD
    start, shading = _start(at[0], at[1], at[2], vertex)

    def per_bit(left: Any, bits: Any) -> tuple:
        b = dr.tzcnt(left)
        direction, ray = emitters.shadow_ray(start, first + b)
        facing = dr.dot(shading, direction) > 0
        lit = facing & ~scene.ray_test(ray, True, facing)
        return left & (left - 1), bits | (mi.UInt32(lit) << b)

    _, bits = dr.while_loop((asked, dr.gather(mi.UInt32, bitmask, target)), lambda left, _: left != 0, per_bit)
    dr.scatter(bitmask, bits, target)
    dr.eval(bitmask)
    return bitmask


def _start(position: Any, normal: Any, facet: Any, index: Any) -> tuple:
    """Return the interactions that shadow rays start from, and their shading normals."""
    start = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    start.p = dr.gather(mi.Point3f, mi.Point3f(position), index)
    start.n = dr.gather(mi.Normal3f, mi.Normal3f(facet), index)
    return start, dr.gather(mi.Vector3f, mi.Vector3f(normal), index)


def _pixel_of_vertex(segments: tuple, count: int) -> "mi.UInt32":
    """Return for every vertex the number of its run."""
    flags = dr.zeros(mi.UInt32, count)
    dr.scatter(flags, mi.UInt32(1), segments[0])
    return dr.cumsum(flags) - 1
