"""Radiance of traced paths, two surfaces at a time and without any ray.

A kernel lane owns a (light, pixel) and adds up the pixel's vertices in their order: no atomics, one order, the same
bytes on any number of threads.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import Columns, opaque
from render.backend.jit import dr, mi
from render.kernel import highlights
from render.kernel.paths import Paths
from render.kernel.vertices import Vertices
from render.kernel.visibility import WORD
from render.materials.kernels import bsdf
from render.materials.kernels.bsdf import PackedMaterials
from render.materials.kernels.packed import PackedSurfaces

_BLOCK = 128  # pixels whose vertices stay in a core's cache while all lights pass over them


def shade(paths: Paths, surfaces: PackedSurfaces, wanted: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Sum the radiance of surfaces over the paths.

    Surfaces 2 k and 2 k + 1 are shaded in one kernel, which shares what does not depend on the material; always so,
    whichever is wanted, since another kernel might round differently.

    Yields:
        (surface number, (L, size, size, 3) float32), summed (not averaged) over the samples of the pass.
    """
    wanted = list(wanted)
    for first in range(0, len(surfaces), 2):
        pair = [number for number in (first, first + 1) if number < len(surfaces)]
        if set(pair) & set(wanted):
            for number, stack in zip(pair, _shade_together(paths, surfaces, pair), strict=True):
                if number in wanted:
                    yield number, stack


def _shade_together(paths: Paths, surfaces: PackedSurfaces, numbers: list[int]) -> list[np.ndarray]:
    images = [dr.zeros(mi.Float, paths.lights * paths.size**2 * 3) for _ in numbers]
    dr.eval(images)
    fitted = [
        bool(surfaces.parts[number])
        and all(isinstance(surfaces.families[part.family], PackedMaterials) for part in surfaces.parts[number])
        for number in numbers
    ]
    for depth, vertices in enumerate(paths.depths):
        shared = depth == 0 and paths.parallel
        fast = [k for k in range(len(numbers)) if shared and fitted[k]]
        for together in _of_one_normal(vertices, numbers, fast):
            chosen = [numbers[k] for k in together]
            _add_camera_hits([images[k] for k in together], paths, vertices, surfaces, chosen)
        for k in set(range(len(numbers))) - set(fast):
            _add_vertices(images[k], paths, vertices, surfaces, numbers[k])
    stacks = []
    for number, image in zip(numbers, images, strict=True):
        stack = np.array(image)
        if surfaces.glossy[number] and paths.glints is not None:
            _add_glints(stack, paths, surfaces, number)
        stacks.append(stack.reshape(paths.lights, paths.size, paths.size, 3))
    return stacks


def _of_one_normal(vertices: Vertices, numbers: list[int], fast: list[int]) -> list[list[int]]:
    """Group places in `numbers`: those without relief together, every other alone."""
    plain = [k for k in fast if vertices.turned[numbers[k]] is None]
    return [group for group in (plain, *([k] for k in fast if k not in plain)) if group]


class _Lanes(NamedTuple):
    """One lane per (light, pixel with vertices): all lights of a block of pixels, then those of the next."""

    light: Any
    start: Any
    length: Any
    entry: Any  # first of the light's in the visibility bitmask
    bit: Any
    target: Any  # of the red channel


def _lanes(paths: Paths, vertices: Vertices) -> _Lanes:
    pixels, count = opaque(mi.UInt32(dr.width(vertices.pixels))), opaque(mi.UInt32(vertices.count))
    lane, lights = dr.arange(mi.UInt32, paths.lights * dr.width(vertices.pixels)), opaque(mi.UInt32(paths.lights))
    first = lane // (_BLOCK * lights) * _BLOCK  # pixel of the block
    within = lane - first * lights
    width = dr.minimum(pixels - first, _BLOCK)
    light = within // width
    pixel = first + within - light * width
    return _Lanes(
        light=light,
        start=dr.gather(mi.UInt32, vertices.start, pixel),
        length=dr.gather(mi.UInt32, vertices.length, pixel),
        entry=(light // WORD) * count,
        bit=light % WORD,
        target=3 * (light * opaque(mi.UInt32(paths.size**2)) + dr.gather(mi.UInt32, vertices.pixels, pixel)),
    )


def _accumulate(images: list, vertices: Vertices, lanes: _Lanes, reflect: Any) -> None:
    """Add the radiances `reflect(vertex)`, one per image, over the vertices of each lane that see its light."""

    def per_vertex(i: Any, *totals: Any) -> tuple:
        at = lanes.start + i
        lit = ((dr.gather(mi.UInt32, vertices.bitmask, lanes.entry + at) >> lanes.bit) & 1) != 0
        values = dr.if_stmt((at,), lit, reflect, lambda at: tuple(mi.Color3f(0) for _ in images))
        return i + 1, *(total + value for total, value in zip(totals, values, strict=True))

    state = (mi.UInt32(0), *(mi.Color3f(0) for _ in images))
    _, *totals = dr.while_loop(state, lambda i, *_: i < lanes.length, per_vertex)
    for image, total in zip(images, totals, strict=True):
        for channel in range(3):
            dr.scatter_reduce(
                dr.ReduceOp.Add, image, math.pi * total[channel], lanes.target + channel, mode=dr.ReduceMode.NoConflicts
            )
    dr.eval(images)


def _add_vertices(image: Any, paths: Paths, vertices: Vertices, surfaces: PackedSurfaces, number: int) -> None:
    """Add the light reflected at one depth, by any kind of material."""
    lanes, weights = _lanes(paths, vertices), vertices.weights[number]
    weigh = _partition(paths, vertices, lanes, surfaces, number)
    hits = Columns(vertices.normal_of(number), vertices.wi, vertices.throughput[number], *(weights or ()))
    reach = paths.emitters.reach(lanes.light, vertices.position)

    def reflect(at: Any) -> Any:
        direction, strength = reach(at)
        normal, wi, throughput, *shares = hits.at(at)
        normal = mi.Vector3f(*normal)
        frame = mi.Frame3f(normal)
        here = None if weights is None else tuple(shares)
        value = surfaces.eval(number, frame.to_local(mi.Vector3f(*wi)), frame.to_local(direction), here)
        value = dr.select(_carrier_faces(vertices, number, at, direction), value, 0)
        return (mi.Color3f(*throughput) * value * weigh(at, normal) * strength,)

    _accumulate([image], vertices, lanes, reflect)


def _carrier_faces(vertices: Vertices, number: int, at: Any, direction: Any) -> Any:
    """Return whether the surface that carries a relief faces the light.

    The bitmask does not: a sample that follows its pixel's probes may face away (`probed_visibility`). Without a
    relief the material is black there by itself.
    """
    if vertices.turned[number] is None:
        return mi.Bool(True)
    return dr.dot(dr.gather(mi.Vector3f, mi.Vector3f(vertices.normal), at), direction) > 0


def _add_camera_hits(
    images: list, paths: Paths, vertices: Vertices, surfaces: PackedSurfaces, numbers: list[int]
) -> None:
    """Add the light that surfaces of fitted materials reflect straight to the camera.

    Camera and lights are distant (`Paths.parallel`): all hits share the direction to the camera, so per light the half
    vector and theta_d are constant: the tables shrink to a row over theta_h per light (`PackedMaterials.rows`), and the
    factor of theta_i to one per hit.
    """
    lanes, wi = _lanes(paths, vertices), mi.Vector3f(vertices.wi)
    direction = dr.gather(mi.Vector3f, paths.directions, lanes.light)
    half = dr.normalize(wi + direction)
    cos_d = dr.minimum(dr.dot(wi, half), 1)
    weighs = [_partition(paths, vertices, lanes, surfaces, number) for number in numbers]
    materials = [_camera_rows(paths, vertices, surfaces, number, wi) for number in numbers]
    hits = Columns(vertices.normal_of(numbers[0]), *(scale for parts in materials for *_, scale in parts))

    def reflect(at: Any) -> Any:
        normal, *scales = hits.at(at)
        normal, left = mi.Vector3f(*normal), iter(scales)
        cos_i, cos_o = dr.dot(normal, wi), dr.dot(normal, direction)
        sin2_h = dr.squared_norm(dr.cross(normal, half))
        entry = bsdf.half_cell(sin2_h, dr.dot(normal, half))
        azimuth = bsdf.azimuth(cos_i, cos_o, sin2_h, cos_d)
        shadow = bsdf.shadow_cell(cos_o)
        faces = _carrier_faces(vertices, numbers[0], at, direction)
        lit = dr.select((cos_i > 0) & (cos_o > 0) & faces, cos_o, 0)
        values = []
        for parts, weigh in zip(materials, weighs, strict=True):
            total = mi.Color3f(0)
            for family, index, rows, _ in parts:
                value = family.eval_row(rows, lanes.light, entry, azimuth) * family.shadow(index, shadow)
                total += value * mi.Color3f(*next(left))
            values.append(total * lit * weigh(at, normal))
        return tuple(values)

    _accumulate(images, vertices, lanes, reflect)


def _camera_rows(paths: Paths, vertices: Vertices, surfaces: PackedSurfaces, number: int, wi: Any) -> list[tuple]:
    """Return per material of a surface its family, number, rows, and S(theta_i) times its weight at the hits."""
    parts, weights = [], vertices.weights[number]
    for k, part in enumerate(surfaces.parts[number]):
        family, index = surfaces.families[part.family], opaque(mi.UInt32(part.member))
        scale = family.shadow(index, bsdf.shadow_cell(dr.dot(vertices.normal_of(number), wi)))
        if weights is not None:
            scale *= weights[k]
        parts.append((family, index, family.rows(index, wi, paths.directions), scale))
    return parts


def _partition(paths: Paths, vertices: Vertices, lanes: _Lanes, surfaces: PackedSurfaces, number: int) -> Any:
    """Return the function that weighs a camera hit against the normals drawn around the half vector."""
    if vertices.spread is None or not surfaces.glossy[number]:
        return lambda at, normal: mi.Float(1)
    if paths.parallel:
        shared = dr.normalize(mi.Vector3f(vertices.wi) + dr.gather(mi.Vector3f, paths.directions, lanes.light))

    def weigh(at: Any, normal: Any) -> Any:
        half = shared if paths.parallel else paths.halves.of(lanes.light, dr.gather(mi.Point3f, vertices.centre, at))
        spread = dr.gather(mi.Float, vertices.spread, at)
        return highlights.partition(spread, highlights.one_minus_cos(normal, half), paths.size, paths.spp)

    return weigh


def _add_glints(stack: np.ndarray, paths: Paths, surfaces: PackedSurfaces, number: int) -> None:
    """Add the points found from the lights' mirror directions, in their order."""
    glints = paths.glints
    frame = mi.Frame3f(glints.normal)
    wi, wo, factor = frame.to_local(glints.wi), frame.to_local(glints.wo), glints.factor * glints.strength
    value = surfaces.eval(number, wi, wo, glints.weights[number]) * factor * math.pi
    dr.eval(value)
    pixels = stack.reshape(-1, 3)
    for channel in range(3):
        pixels[:, channel] += np.bincount(glints.target, np.array(value[channel], np.float64), len(pixels))
