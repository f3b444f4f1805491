"""Where paths go on: directions from the mixture of all materials' lobes, and the end of paths that carry little."""

from typing import Any

from render.backend.arrays import opaque
from render.backend.jit import dr, mi
from render.backend.sampling import bounce_variates, random_variates, stream
from render.kernel.vertices import Vertices
from render.materials.kernels.packed import PackedSurfaces

_FULL = 4.0  # a path that may end goes on for certain where it carries 1 / _FULL or more
_LEAST_CHANCE = 0.25


def bounce(
    vertices: Vertices, surfaces: PackedSurfaces, seed: int, depth: int, first: int, spp: int, ends: bool
) -> tuple["mi.Ray3f", tuple]:
    """Draw the next direction from the mixture of all materials' lobes; `ends` lets paths end early.

    Returns:
        The rays, and per surface the throughput with the weight f cos / density.
    """
    if depth == 1:
        per_pixel = opaque(mi.UInt32(spp))
        pixel = vertices.sample // per_pixel
        number = vertices.sample - pixel * per_pixel + opaque(mi.UInt32(first))
        chosen, u, v = bounce_variates(pixel, number, stream(seed, depth))
    else:
        chosen, u, v = random_variates(vertices.sample, stream(seed, (first << 8) + depth))
    lobe, _, _ = random_variates(vertices.sample, stream(seed, (first << 8) + 128 + depth))
    if any(normal is not None for normal in vertices.turned):
        towards, density, factors = _draw_mixed_frames(vertices, surfaces, chosen, lobe, mi.Point2f(u, v))
    else:
        frame = mi.Frame3f(vertices.normal)
        wi = frame.to_local(vertices.wi)
        dr.eval(wi, chosen, u, v, lobe)
        wo, density = surfaces.sample(vertices.weights, wi, chosen, lobe, mi.Point2f(u, v))
        scale = dr.select(density > 0, dr.rcp(density), 0)
        dr.eval(wi, wo, scale)
        factors = [surfaces.eval(number, wi, wo, vertices.weights[number]) * scale for number in range(len(surfaces))]
        towards = frame.to_world(wo)
    start = dr.zeros(mi.SurfaceInteraction3f, vertices.count)
    start.p, start.n = vertices.position, vertices.facet
    ray = start.spawn_ray(towards)
    ray.maxt = dr.select(density > 0, ray.maxt, 0)
    throughput = tuple(value * factor for value, factor in zip(vertices.throughput, factors, strict=True))
    if ends:
        ray.maxt, throughput = roulette(ray.maxt, throughput, vertices.sample, stream(seed, (first << 8) + 64 + depth))
    dr.eval(ray, throughput)
    return ray, throughput


def _draw_mixed_frames(vertices: Vertices, surfaces: PackedSurfaces, chosen: Any, lobe: Any, point: Any) -> tuple:
    """Do the same where some surfaces have a relief: each of these is drawn for alone, the others together.

    Returns:
        Directions (N), their density (N) in the mixture of all surfaces, and the factors.
    """
    plain = [number for number, normal in enumerate(vertices.turned) if normal is None]
    groups = [[number] for number in range(len(surfaces)) if number not in plain]
    groups += [plain] if plain else []
    frames = [mi.Frame3f(vertices.normal_of(group[0])) for group in groups]
    local = [frame.to_local(vertices.wi) + dr.zeros(mi.Vector3f, vertices.count) for frame in frames]
    dr.eval(local, chosen, lobe, point)
    towards, edge = mi.Vector3f(0, 0, 1), 0.0
    for group, frame, wi in zip(groups, frames, local, strict=True):
        share = len(group) / len(surfaces)
        within = (chosen - opaque(mi.Float(edge))) * opaque(mi.Float(1 / share))
        wo = surfaces.draw(vertices.weights, wi, dr.clip(within, 0, 1 - 2**-24), lobe, point, group)
        towards = dr.select(within >= 0, frame.to_world(wo), towards)
        edge += share
    dr.eval(towards)
    above = dr.dot(vertices.normal, towards) > 0  # below, the surface hides what its relief would reflect
    density, ends = mi.Float(0), []
    for group, frame, wi in zip(groups, frames, local, strict=True):
        wo = frame.to_local(towards)
        dr.eval(wo)
        density += surfaces.density(vertices.weights, wi, wo, group) * opaque(mi.Float(len(group) / len(surfaces)))
        ends += [(number, wi, wo) for number in group]
    density = dr.select(above, density, 0)
    scale = dr.select(density > 0, dr.rcp(density), 0)
    towards = dr.select(density > 0, towards, vertices.normal)  # no ray is cast along what could not be drawn
    dr.eval(density, scale, towards)
    found = {number: surfaces.eval(number, wi, wo, vertices.weights[number]) * scale for number, wi, wo in ends}
    return towards, density, [found[number] for number in range(len(surfaces))]


def roulette(reach: Any, throughput: tuple, sample: Any, seed: Any) -> tuple:
    """End paths that carry little at random (Russian roulette, Veach 1997, eq. 10.2); the others carry more instead."""
    carried = mi.Float(0)
    for value in throughput:
        carried = dr.maximum(carried, dr.max(value))
    chance = dr.clip(_FULL * carried, _LEAST_CHANCE, 1)
    drawn, _, _ = random_variates(sample, seed)
    return dr.select(drawn < chance, reach, 0), tuple(value * dr.rcp(chance) for value in throughput)
