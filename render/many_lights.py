"""All lights of a scene from one set of paths: the fast renderer.

Neither the camera path nor the shadow rays depend on the BRDF, and the path does not depend on the
light. So `trace` follows the camera paths once, keeps their vertices, and records one bit per (vertex, light): lit or
not. `shade` then sums BRDF x visibility over the vertices of each pixel, for one material at a
time, without a single ray. Many lights, and many materials per view, share all rays.

The sum over a pixel runs in one lane in a fixed order, so the same seed gives the same bytes whatever the
number of threads. Noise is correlated between the lights and materials of a view, which share paths.

Estimator: next-event estimation at every vertex (Kajiya 1986; Veach 1997, eq. 8.10), with bounce directions drawn from
the mixture of the sampling lobes of all materials of the view, weighted by the mixture's density (one-sample balance
heuristic, Veach 1997, eq. 9.15). The slow counterpart is `render.reference`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from render import variant
from render.manifest import View
from render.materials.bsdf import PackedMaterials

mi = variant.load()

SAMPLES_PER_PASS = 1 << 21  # bounds the memory of one pass (about 0.3 GB) at any size and sample count
_WORD = 32  # lights per visibility word


@dataclass(frozen=True)
class Vertices:
    """Path vertices of one depth, sorted by pixel; all arrays are Dr.Jit, in the object frame.

    `words` holds the visibility bits: bit b of entry `w * N + i` tells whether vertex i sees light 32 w + b.
    """

    count: int
    position: Any  # Point3f (N)
    normal: Any  # Vector3f (N), shading normal
    wi: Any  # Vector3f (N, or 1 at the camera hits), to the previous vertex
    sample: Any  # UInt32 (N), number of the camera sample
    words: Any  # UInt32 (ceil(L / 32) * N)
    throughput: tuple  # K Color3f (N, or 1 at the camera hits): f cos / density along the path so far
    pixels: Any  # UInt32 (Q), pixels with at least one vertex
    start: Any  # UInt32 (Q), first vertex of the pixel
    length: Any  # UInt32 (Q), number of vertices of the pixel


@dataclass(frozen=True)
class Paths:
    """What `trace` found: everything `shade` needs, and the ground truth of the view.

    Attributes:
        depths: Vertices per depth, camera hits first.
        directions: Light directions in the object frame (Dr.Jit, L).
        lights, size, spp: Counts.
        hits: (P,) uint32, samples per pixel that hit the object.
        normal_sum: (P, 3) float64, sum of shading normals of the hits, camera frame.
        depth_sum: (P,) float64, sum of z of the hits, in half image widths.
    """

    depths: tuple[Vertices, ...]
    directions: Any
    lights: int
    size: int
    spp: int
    hits: np.ndarray
    normal_sum: np.ndarray
    depth_sum: np.ndarray


@dataclass(frozen=True)
class GroundTruth:
    """Camera-frame truth of a view; arrays as in `render.shards.Shard`."""

    normals: np.ndarray  # (H, W, 3) float32
    depth: np.ndarray  # (H, W) float32
    mask: np.ndarray  # (H, W) bool
    coverage: np.ndarray  # (H, W) float32


def render(
    scene: "mi.Scene",
    view: View,
    materials: PackedMaterials,
    lights: np.ndarray,
    *,
    size: int,
    spp: int,
    bounces: int,
    seed: int,
    only: Sequence[int] | None = None,
) -> tuple[GroundTruth, Iterator[tuple[int, np.ndarray]]]:
    """Render one view of `scene` with every material under every light.

    Args:
        scene: One object in the unit sphere (see `render.scene.build`).
        view: Pose.
        materials: K materials; each in turn covers the whole object.
        lights: (L, 3) unit vectors to the lights, camera frame.
        size: Image side in pixels.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces after the first hit.
        seed: Sampler seed (32 bits).
        only: Material numbers to shade; all by default. The bytes do not depend on it.

    Returns:
        The ground truth, and an iterator over (material number, images) with images (L, size, size, 3) float32,
        linear radiance under irradiance pi. Passes over many samples are averaged.
    """
    wanted = range(len(materials)) if only is None else only
    per_pass = max(1, SAMPLES_PER_PASS // size**2)
    passes = (
        trace(scene, view, materials, lights, size=size, spp=min(per_pass, spp - first), bounces=bounces,
              seed=seed, first=first, total=spp)
        for first in range(0, spp, per_pass)
    )  # fmt: skip
    first_pass = next(passes)
    if per_pass >= spp:  # shaded one by one as they are asked for, so that a hundred materials need no more memory
        images = ((index, _averaged(shade(first_pass, materials, index), spp)) for index in wanted)
        return _ground_truth([first_pass], size, spp), images
    stacks = {index: shade(first_pass, materials, index) for index in wanted}
    truths = [_without_paths(first_pass)]
    del first_pass
    for paths in passes:
        truths.append(_without_paths(paths))
        for index in wanted:
            stacks[index] += shade(paths, materials, index)
    images = ((index, _averaged(stacks.pop(index), spp)) for index in wanted)
    return _ground_truth(truths, size, spp), images


def trace(
    scene: "mi.Scene",
    view: View,
    materials: PackedMaterials,
    lights: np.ndarray,
    *,
    size: int,
    spp: int,
    bounces: int,
    seed: int,
    first: int = 0,
    total: int | None = None,
) -> Paths:
    """Follow the camera paths of samples `first` to `first + spp - 1` of `total` per pixel; see `render`."""
    rotation = _opaque(mi.Matrix3f(view.matrix()))
    rows = np.ascontiguousarray(lights.T, dtype=np.float32)  # uploaded one by one for the reason given at `_numpy`
    directions = _opaque(mi.Vector3f(rotation.T @ mi.Vector3f(*(mi.Float(row) for row in rows))))
    ray, sample = _camera_rays(view, rotation, size, spp, seed, first, total or spp)
    depths: list[Vertices] = []
    pixel_count, throughput = size * size, (mi.Color3f(1),) * len(materials)
    for depth in range(bounces + 1):
        found = scene.ray_intersect(ray, +mi.RayFlags.ShadingFrame, depth == 0)
        wi = -ray.d
        # A one-sided BSDF is black from behind, so such paths end here, as they do in Mitsuba's `path`.
        alive = found.is_valid() & ((depth == 0) | (dr.dot(found.sh_frame.n, wi) > 0))
        # Together, or each gather below would trace the rays again.
        dr.eval(alive, found.p, found.n, found.sh_frame.n, wi, sample, throughput)
        kept = dr.compress(alive)
        if len(kept) == 0:
            break
        throughput = tuple(_take(mi.Color3f, value, kept) for value in throughput)
        position, normal = _take(mi.Point3f, found.p, kept), _take(mi.Vector3f, found.sh_frame.n, kept)
        facet, wi = _take(mi.Vector3f, found.n, kept), _take(mi.Vector3f, wi, kept)
        sample = _take(mi.UInt32, sample, kept)
        dr.eval(position, normal, facet, wi, sample, throughput)
        words = _visibility(scene, position, normal, facet, directions, len(lights))
        pixels, start, length = _segments(sample, spp, pixel_count)
        depths.append(Vertices(len(kept), position, normal, wi, sample, words, throughput, pixels, start, length))
        if depth < bounces:
            ray, weights = _bounce(depths[-1], facet, materials, seed, depth + 1, first)
            throughput = tuple(value * weight for value, weight in zip(throughput, weights, strict=True))
    return Paths(tuple(depths), directions, len(lights), size, spp, *_sums(depths, view, spp, pixel_count))


def shade(paths: Paths, materials: PackedMaterials, index: int) -> np.ndarray:
    """Sum the radiance of material `index` over the paths.

    Returns:
        (L, size, size, 3) float32, summed (not averaged) over the samples of the pass.
    """
    pixel_count = paths.size**2
    image = dr.zeros(mi.Float, paths.lights * pixel_count * 3)
    dr.eval(image)
    material = _opaque(mi.UInt32(index))
    for vertices in paths.depths:
        _add_depth(image, paths, vertices, vertices.throughput[index], materials, material)
    return np.array(image).reshape(paths.lights, paths.size, paths.size, 3)


def _averaged(image: np.ndarray, spp: int) -> np.ndarray:
    """Divide by the samples in place: the stack is the largest array there is."""
    image /= spp
    return image


def _without_paths(paths: Paths) -> Paths:
    """Keep only the ground truth of a pass, so that its vertices can be freed."""
    return replace(paths, depths=())


def _add_depth(
    image: Any, paths: Paths, vertices: Vertices, throughput: Any, materials: PackedMaterials, material: Any
) -> None:
    """Add the light reflected at one depth; a lane owns a (light, pixel), so plain sums suffice and have one order."""
    pixels, count = _opaque(mi.UInt32(dr.width(vertices.pixels))), _opaque(mi.UInt32(vertices.count))
    stride = _opaque(mi.UInt32(paths.size**2))
    lane = dr.arange(mi.UInt32, paths.lights * dr.width(vertices.pixels))
    light = lane // pixels
    pixel = lane - light * pixels
    start, length = dr.gather(mi.UInt32, vertices.start, pixel), dr.gather(mi.UInt32, vertices.length, pixel)
    direction = dr.gather(mi.Vector3f, paths.directions, light)
    words, bit = (light // _WORD) * count, light % _WORD

    def reflect(at: Any) -> Any:
        frame = mi.Frame3f(dr.gather(mi.Vector3f, vertices.normal, at))
        wi = frame.to_local(_take(mi.Vector3f, vertices.wi, at))
        return _take(mi.Color3f, throughput, at) * materials.eval(material, wi, frame.to_local(direction))

    def per_vertex(i: Any, total: Any) -> tuple:
        at = start + i
        lit = ((dr.gather(mi.UInt32, vertices.words, words + at) >> bit) & 1) != 0
        return i + 1, total + dr.if_stmt((at,), lit, reflect, lambda at: mi.Color3f(0))

    _, total = dr.while_loop((mi.UInt32(0), mi.Color3f(0)), lambda i, total: i < length, per_vertex)
    target = 3 * (light * stride + dr.gather(mi.UInt32, vertices.pixels, pixel))
    for channel in range(3):
        dr.scatter_reduce(
            dr.ReduceOp.Add, image, math.pi * total[channel], target + channel, mode=dr.ReduceMode.NoConflicts
        )
    dr.eval(image)


def _camera_rays(
    view: View, rotation: Any, size: int, spp: int, seed: int, first: int, total: int
) -> tuple["mi.Ray3f", "mi.UInt32"]:
    """Cast orthographic rays, in the object frame, through a rotated Hammersley set in every pixel.

    The camera moves and the object stays, so that its acceleration structure serves every view.
    """
    side, per_pixel = _opaque(mi.UInt32(size)), _opaque(mi.UInt32(spp))
    index = dr.arange(mi.UInt32, size * size * spp)
    pixel = index // per_pixel
    number = index % per_pixel + _opaque(mi.UInt32(first))
    shift = mi.PCG32(initstate=_stream(seed, 0), initseq=mi.UInt64(pixel))
    u = mi.Float(number) / _opaque(mi.Float(total)) + shift.next_float32()
    v = mi.radical_inverse_2(number, 0) + shift.next_float32()
    half = 2 / mi.Float(side)
    x = (mi.Float(pixel % side) + u - dr.floor(u)) * half - 1
    y = 1 - (mi.Float(pixel // side) + v - dr.floor(v)) * half
    scale = _opaque(mi.Float(view.scale))
    offset = _opaque(mi.Vector2f(*view.offset))
    origin = rotation.T @ mi.Vector3f((x - offset.x) / scale, (y - offset.y) / scale, 4)
    direction = rotation.T @ mi.Vector3f(0, 0, -1)
    return mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)), index


def _visibility(scene: "mi.Scene", position: Any, normal: Any, facet: Any, directions: Any, lights: int) -> "mi.UInt32":
    """Cast one shadow ray per vertex and light; return the packed bits (see `Vertices.words`)."""
    count, groups = dr.width(position), -(-lights // _WORD)
    width, total = _opaque(mi.UInt32(count)), _opaque(mi.UInt32(lights))
    lane = dr.arange(mi.UInt32, count * groups)
    first = lane // width * _WORD
    vertex = lane - first // _WORD * width
    start = dr.zeros(mi.SurfaceInteraction3f, count * groups)
    start.p, start.n = _take(mi.Point3f, position, vertex), _take(mi.Normal3f, facet, vertex)
    shading = _take(mi.Vector3f, normal, vertex)

    def per_light(b: Any, bits: Any) -> tuple:
        light = first + b
        direction = dr.gather(mi.Vector3f, directions, light)
        facing = dr.dot(shading, direction) > 0
        lit = facing & ~scene.ray_test(start.spawn_ray(direction), True, facing)
        return b + 1, bits | (mi.UInt32(lit) << b)

    state = (mi.UInt32(0), mi.UInt32(0))
    _, words = dr.while_loop(state, lambda b, _: (b < _WORD) & (first + b < total), per_light)
    dr.eval(words)
    return words


def _bounce(
    vertices: Vertices, facet: Any, materials: PackedMaterials, seed: int, depth: int, first: int
) -> tuple["mi.Ray3f", list]:
    """Draw the next direction from the mixture of all materials' lobes.

    Returns:
        The rays, and per material the weight f cos / density.
    """
    rng = mi.PCG32(initstate=_stream(seed, (first << 8) + depth), initseq=mi.UInt64(vertices.sample))
    total = _opaque(mi.UInt32(len(materials)))
    frame = mi.Frame3f(vertices.normal)
    wi = frame.to_local(vertices.wi)
    chosen = dr.minimum(mi.UInt32(rng.next_float32() * mi.Float(total)), total - 1)
    lobe, point = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    wo = materials.sample_lobe(chosen, wi, lobe, point)

    def add(k: Any, density: Any) -> tuple:
        return k + 1, density + materials.pdf(k, wi, wo)

    _, density = dr.while_loop((mi.UInt32(0), mi.Float(0)), lambda k, _: k < total, add)
    density /= mi.Float(total)
    scale = dr.select(density > 0, dr.rcp(density), 0)
    dr.eval(wi, wo, scale)
    weights = [materials.eval(_opaque(mi.UInt32(k)), wi, wo) * scale for k in range(len(materials))]
    start = dr.zeros(mi.SurfaceInteraction3f, vertices.count)
    start.p, start.n = vertices.position, facet
    ray = start.spawn_ray(frame.to_world(wo))
    ray.maxt = dr.select(density > 0, ray.maxt, 0)
    dr.eval(ray, weights)
    return ray, weights


def _segments(sample: Any, spp: int, pixel_count: int) -> tuple:
    """Find the run of vertices of each pixel: samples are numbered pixel by pixel and kept in that order."""
    counts = dr.zeros(mi.UInt32, pixel_count)
    dr.scatter_reduce(dr.ReduceOp.Add, counts, mi.UInt32(1), sample // _opaque(mi.UInt32(spp)))
    starts = dr.prefix_sum(counts)
    pixels = dr.compress(counts > 0)
    start, length = dr.gather(mi.UInt32, starts, pixels), dr.gather(mi.UInt32, counts, pixels)
    dr.eval(start, length)
    return pixels, start, length


def _sums(depths: list[Vertices], view: View, spp: int, pixel_count: int) -> tuple:
    """Sum hits, camera-frame normals and depths of the first vertices per pixel."""
    hits, normals, depth = np.zeros(pixel_count, np.uint32), np.zeros((pixel_count, 3)), np.zeros(pixel_count)
    if depths:
        first, rotation = depths[0], view.matrix()
        pixels, starts = np.array(first.pixels), np.array(first.start)
        hits[pixels] = np.array(first.length)
        normals[pixels] = np.add.reduceat(_numpy(first.normal).T @ rotation.T, starts)
        z = _numpy(first.position).T @ rotation[2] * view.scale
        depth[pixels] = np.add.reduceat(z, starts)
    return hits, normals, depth


def _ground_truth(passes: list[Paths], size: int, spp: int) -> GroundTruth:
    """Average the passes; a pixel belongs to the mask when at least half of its samples hit the object."""
    hits = sum(paths.hits for paths in passes).astype(np.float64)
    normals = sum(paths.normal_sum for paths in passes)
    depth = sum(paths.depth_sum for paths in passes) / np.maximum(hits, 1)
    length = np.linalg.norm(normals, axis=1)
    mask = (2 * hits >= spp) & (length > 0)
    unit = np.where(mask[:, None], normals / np.maximum(length, 1e-12)[:, None], 0)
    return GroundTruth(
        normals=unit.reshape(size, size, 3).astype(np.float32),
        depth=np.where(mask, depth, 0).reshape(size, size).astype(np.float32),
        mask=mask.reshape(size, size),
        coverage=(hits / spp).reshape(size, size).astype(np.float32),
    )


def _stream(seed: int, stage: int) -> "mi.UInt64":
    """Return an opaque PCG32 state of its own for each (seed, stage)."""
    state = np.random.SeedSequence([seed, stage]).generate_state(1, np.uint64)[0]
    return _opaque(mi.UInt64(int(state)))


def _take(kind: type, source: Any, index: Any) -> Any:
    """Gather the lanes `index` of an array; one that is uniform (width 1) stays so."""
    source = kind(source)
    return dr.gather(kind, source, index) if dr.width(source) > 1 else source


def _numpy(vectors: Any) -> np.ndarray:  # (3, N) float64
    """Convert by component: Dr.Jit's own conversion has N in its code, and would compile anew for every view."""
    return np.stack([np.array(component, dtype=np.float64) for component in vectors])


def _opaque(value: Any) -> Any:
    """Hide a value from the kernel's code, so that another value does not compile another kernel."""
    dr.make_opaque(value)
    return value
