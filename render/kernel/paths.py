"""Camera paths and their shadow rays: all of a view's rays, which do not depend on its lights and materials."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from render.backend.arrays import opaque
from render.backend.jit import dr, mi
from render.backend.sampling import pixel_position, stream
from render.kernel import highlights
from render.kernel.bounces import bounce
from render.kernel.camera import Camera
from render.kernel.emitters import DistantLights, NearLights, place
from render.kernel.vertices import Vertices, take
from render.kernel.visibility import WORD, group_visibility, probe_count, probe_visibility, visibility
from render.materials.kernels.packed import PackedSurfaces
from render.materials.kernels.textures.cover import Place
from render.records.manifest import View
from render.shapes.geometry.mesh import TriangleMesh


@dataclass(frozen=True)
class Paths:
    """What `trace` found: everything shading needs, and the ground truth of the view.

    Attributes:
        depths: Vertices per depth, camera hits first.
        glints: Points found from the lights' mirror directions, or None.
        emitters: The lights in the object frame.
        parallel: Whether camera and lights are distant, so that the camera's hits share the directions to both.
        halves: Half vectors of `render.kernel.highlights`, or None where no highlight is narrow.
        lights, size, spp: Counts.
        hits: (P,) uint32, samples per pixel that hit the object.
        normal_sum: (P, 3) float64, sum of shading normals of the hits, camera frame.
        depth_sum: (P,) float64, sum of z of the hits, in half image widths.
        weight_sums: Per surface (M, P) float64, sum of the weights of its materials over the hits, or None.
        turned_sums: Per surface (P, 3) float64, as `normal_sum` with its relief, or None.
        object_hits: (P, O) uint32, samples per pixel that hit each object of a composition, or None.
    """

    depths: tuple[Vertices, ...]
    glints: Any
    emitters: DistantLights | NearLights
    parallel: bool
    halves: Any
    lights: int
    size: int
    spp: int
    hits: np.ndarray
    normal_sum: np.ndarray
    depth_sum: np.ndarray
    weight_sums: tuple
    turned_sums: tuple
    object_hits: np.ndarray | None

    @property
    def directions(self) -> Any:
        """Directions to distant lights in the object frame (Dr.Jit, L)."""
        assert isinstance(self.emitters, DistantLights)
        return self.emitters.directions


def trace(
    scene: Any, view: View, surfaces: PackedSurfaces, lights: np.ndarray, *, size: int, spp: int, bounces: int,
    seed: int, distances: np.ndarray | None = None, first: int = 0, probe: bool = True,
) -> Paths:  # fmt: skip
    """Follow the camera paths of samples `first` to `first + spp - 1` of every pixel; see `many_lights.render`."""
    camera = Camera.of(view, size)
    emitters = place(camera, lights, distances)
    ray, sample = _camera_rays(camera, spp, seed, first)
    parallel = camera.parallel and isinstance(emitters, DistantLights)
    halves = highlights.half_vectors(camera, emitters, parallel) if any(surfaces.glossy) else None
    depths: list[Vertices] = []
    composed = scene.mesh.objects is not None  # much of its light has bounced
    throughput = (mi.Color3f(1),) * len(surfaces)
    for depth in range(bounces + 1):
        found, uv = scene.ray_intersect(ray, depth == 0)
        wi, prim = -ray.d, found.prim_index
        # A one-sided BSDF is black from behind, so such paths end here, as they do in Mitsuba's `path`.
        alive = found.is_valid() & ((depth == 0) | (dr.dot(found.sh_frame.n, wi) > 0))
        # Together, or each gather below would trace the rays again.
        dr.eval(alive, found.p, found.n, found.sh_frame.n, wi, prim, uv, sample, throughput)
        kept = dr.compress(alive)
        if len(kept) == 0:
            break
        if len(kept) == 1 and depth > 0:
            # Dr.Jit treats an array of one entry as uniform, and would compile everything below once more for it.
            kept = dr.concat([kept, kept])
            throughput = tuple(value * 0.5 for value in throughput)
        throughput = tuple(take(mi.Color3f, value, kept) for value in throughput)
        position, normal = take(mi.Point3f, found.p, kept), take(mi.Vector3f, found.sh_frame.n, kept)
        facet, wi = take(mi.Vector3f, found.n, kept), take(mi.Vector3f, wi, kept)
        sample, uv, prim = take(mi.UInt32, sample, kept), take(mi.Point2f, uv, kept), take(mi.UInt32, prim, kept)
        dr.eval(position, normal, facet, wi, sample, prim, uv, throughput)
        segments = _segments(sample, spp, size * size)
        rays = {"scene": scene, "position": position, "normal": normal, "facet": facet, "emitters": emitters}
        if depth == 0:
            seen = _find_lights(rays, len(lights), sample, spp, segments, probe)
        else:
            seen = None if composed else visibility(**rays, lights=len(lights), coherent=False)
        centre, spread = highlights.normal_spread(scene, camera, prim, uv) if depth == 0 and halves else (None, None)
        covers = surfaces.at(Place(mi.Vector3f(position), normal, prim, uv), wi)  # weights, turned normals
        lit = position, normal, facet, wi, prim, sample, seen, throughput
        depths.append(Vertices(len(kept), *lit, *covers, centre, spread, *segments))
        if depth < bounces:
            ray, throughput = bounce(depths[-1], surfaces, seed, depth + 1, first, spp, composed)
    if composed and len(depths) > 1:
        depths[1:] = _find_lights_together(scene, depths[1:], emitters, len(lights))
    mirrors = (scene, camera, emitters, halves, len(lights), surfaces, spp, seed, first)
    glints = highlights.find(*mirrors) if halves and depths else None
    shared = emitters, parallel, halves, len(lights), size, spp
    return Paths(tuple(depths), glints, *shared, *_sums(depths, camera, surfaces, scene.mesh, spp))


def _find_lights_together(scene: Any, depths: list[Vertices], emitters: Any, lights: int) -> list[Vertices]:
    """Find the lights that the vertices of several depths see, which they share with others close to them."""
    positions, normals, facets = (
        np.concatenate([[np.array(row) for row in column] for column in columns], axis=1)  # row by row: see `place`
        for columns in zip(*((vertices.position, vertices.normal, vertices.facet) for vertices in depths), strict=True)
    )
    bits = group_visibility(scene, positions, normals, facets, emitters, lights)
    total, first, found = opaque(mi.UInt32(positions.shape[1])), 0, []
    for vertices in depths:
        width, lane = opaque(mi.UInt32(vertices.count)), dr.arange(mi.UInt32, vertices.count * -(-lights // WORD))
        word = lane // width
        entry = dr.fma(word, total, lane - word * width + opaque(mi.UInt32(first)))
        found.append(replace(vertices, bitmask=dr.gather(mi.UInt32, bits, entry)))
        dr.eval(found[-1].bitmask)
        first += vertices.count
    return found


def _find_lights(rays: dict[str, Any], lights: int, sample: Any, spp: int, segments: tuple, probe: bool) -> Any:
    """Return what the camera's hits see, whose samples share it where they may."""
    if not probe:
        return visibility(**rays, lights=lights, coherent=True)
    probes = sample % opaque(mi.UInt32(spp)) < opaque(mi.UInt32(probe_count(spp)))
    return probe_visibility(**rays, lights=lights, probes=probes, segments=segments[1:])


def _camera_rays(camera: Camera, spp: int, seed: int, first: int) -> tuple["mi.Ray3f", "mi.UInt32"]:
    """Cast rays through the samples of every pixel; return them and the samples' numbers."""
    side, per_pixel = opaque(mi.UInt32(camera.size)), opaque(mi.UInt32(spp))
    index = dr.arange(mi.UInt32, camera.size**2 * spp)
    pixel = index // per_pixel
    number = index - pixel * per_pixel + opaque(mi.UInt32(first))
    place = pixel_position(pixel, number, stream(seed, 0))
    half, row = 2 / mi.Float(side), pixel // side
    x = (mi.Float(pixel - row * side) + place.x) * half - 1
    y = 1 - (mi.Float(row) + place.y) * half
    return camera.ray(x, y), index


def _segments(sample: Any, spp: int, pixel_count: int) -> tuple:
    """Find the run of vertices of each pixel: samples are numbered pixel by pixel and kept in that order."""
    counts = dr.zeros(mi.UInt32, pixel_count)
    dr.scatter_reduce(dr.ReduceOp.Add, counts, mi.UInt32(1), sample // opaque(mi.UInt32(spp)))
    starts = dr.prefix_sum(counts)
    pixels = dr.compress(counts > 0)
    if len(pixels) == 1:  # for the reason given in `trace`: next to it, another pixel without vertices
        only = int(pixels[0])
        return (
            mi.UInt32([only, (only + 1) % pixel_count]), mi.UInt32([0, 0]), mi.UInt32([dr.width(sample), 0])
        )  # fmt: skip
    start, length = dr.gather(mi.UInt32, starts, pixels), dr.gather(mi.UInt32, counts, pixels)
    dr.eval(start, length)
    return pixels, start, length


def _sums(depths: list[Vertices], camera: Camera, surfaces: PackedSurfaces, mesh: TriangleMesh, spp: int) -> tuple:
    """Sum hits, camera-frame normals, depths, material weights and objects of the first vertices per pixel."""
    pixel_count = camera.size**2
    hits, normals, depth = np.zeros(pixel_count, np.uint32), np.zeros((pixel_count, 3)), np.zeros(pixel_count)
    sums: list = []
    turned: list = []
    if depths:
        first = depths[0]
        pixels = np.array(first.pixels)
        hits[pixels] = np.array(first.length)
        normal, place = camera.rotation @ first.normal, camera.rotation @ mi.Vector3f(first.position)
        columns = _pixel_sums(first, [normal.x, normal.y, normal.z, place.z * camera.scale])
        normals[pixels], depth[pixels] = np.stack(columns[:3], axis=1), columns[3]
        for number, weights in enumerate(first.weights):
            shares = weights is not None and surfaces.shares(number)
            sums.append(np.zeros((len(weights), pixel_count)) if shares else None)
            if shares:
                sums[-1][:, pixels] = _pixel_sums(first, weights)
        for relief in first.turned:
            turned.append(None if relief is None else np.zeros((pixel_count, 3)))
            if relief is not None:
                turned[-1][pixels] = np.stack(_pixel_sums(first, list(camera.rotation @ relief)), axis=1)
    objects = None if mesh.objects is None or not depths else _object_hits(mesh.objects, depths[0], spp, pixel_count)
    return hits, normals, depth, tuple(sums), tuple(turned), objects


def _object_hits(objects: np.ndarray, vertices: Vertices, spp: int, pixel_count: int) -> np.ndarray:
    """Count the samples of each pixel that hit each object, (P, O)."""
    count = int(objects.max()) + 1
    cells = (np.array(vertices.sample, np.int64) // spp) * count + objects[np.array(vertices.prim)]
    return np.bincount(cells, minlength=pixel_count * count).reshape(pixel_count, count).astype(np.uint32)


def _pixel_sums(vertices: Vertices, values: Sequence) -> list[np.ndarray]:
    """Sum Float arrays over the vertices of each pixel that has any; return (Q,) float64 arrays."""
    values = [value + dr.zeros(mi.Float, vertices.count) for value in values]
    dr.eval(values)

    def add(i: Any, *totals: Any) -> tuple:
        at = vertices.start + i
        return i + 1, *(total + dr.gather(mi.Float, value, at) for total, value in zip(totals, values, strict=True))

    state = (mi.UInt32(0), *(mi.Float(0) for _ in values))
    _, *totals = dr.while_loop(state, lambda i, *_: i < vertices.length, add)
    dr.eval(totals)
    return [np.array(total, dtype=np.float64) for total in totals]
