"""Blobby: smooth closed surfaces of varied lumpiness, one per seed.

After the blobs of Johnson and Adelson (2011), spheres displaced by smooth noise. A third of the seeds displace
the sphere along its radius only, a third then carry it along a smooth flow, which bends lobes over into
overhangs, and a third merge several displaced balls into one implicit surface.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh

from render.shapes.geometry import sdf
from render.shapes.geometry.mesh import TriangleMesh, unit
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.polygonise import polygonise
from render.shapes.geometry.sdf import Field
from render.shared import seeds

SUBDIVISIONS = 6  # 81,920 triangles, their edges 2.4 px long where the blob fills 256 px
FLOW_STEPS = 6


@dataclass(frozen=True, kw_only=True)
class BlobParameters:
    """What a seed decides about a blob that is a displaced sphere.

    Attributes:
        lumpiness: Standard deviation of the logarithm of the radius.
        frequency: Smallest wave number of the displacement on the unit sphere, radians per radius.
        bandwidth: Largest wave number over the smallest.
        slope: Fall-off of the amplitudes with the wave number; 0 gives all scales alike.
        crease: 0 displaces by the noise n itself; towards +1 by -|n|, lumps meeting in furrows turned inside
            out, that is ridges; towards -1 by |n|, lumps with furrows between them.
        stretch: Scale along x, y, z before the displacement.
        flow: Mean path length of the flow in radii; 0 leaves the surface star-shaped.
        flow_frequency: Smallest wave number of the flow.
    """

    lumpiness: float
    frequency: float
    bandwidth: float
    slope: float
    crease: float
    stretch: tuple[float, float, float]
    flow: float
    flow_frequency: float


def draw_parameters(rng: np.random.Generator, *, flowing: bool) -> BlobParameters:
    """Draw the parameters of one displaced sphere."""
    frequency = float(np.exp(rng.uniform(np.log(1.6), np.log(7.0))))
    return BlobParameters(
        # Taller lumps where they are wider, so that the slopes stay in one range.
        lumpiness=float(np.exp(rng.uniform(np.log(0.25), np.log(1.1)))) / (frequency + 1),
        frequency=frequency,
        bandwidth=float(rng.uniform(1.2, 3.5)),
        slope=float(rng.uniform(0.7, 2.0)),
        crease=float(rng.uniform(-1, 0.5)) if rng.random() < 0.5 else 0.0,
        stretch=tuple(np.exp(rng.normal(0, 0.16, 3))),
        flow=float(rng.uniform(0.12, 0.45)) if flowing else 0.0,
        flow_frequency=float(rng.uniform(1.5, 3.5)),
    )


def blobby(seed: int) -> TriangleMesh:
    """Build the blob of `seed`, closed and smooth, within the unit sphere."""
    rng = seeds.generator(seed, "blobby")
    kind = ("radial", "flowing", "merged")[rng.integers(3)]
    if kind == "merged":
        return polygonise(merge_balls(rng), half_size=1.8, triangles=60_000).normalise()
    return displace_sphere(rng, draw_parameters(rng, flowing=kind == "flowing")).normalise()


def merge_balls(rng: np.random.Generator) -> Field:
    """Merge a chain of balls, each grown onto an earlier one, and cover the whole with smooth noise."""
    centres, radii = [np.zeros(3)], [rng.uniform(0.4, 0.7)]
    for _ in range(int(rng.integers(1, 9))):
        host = int(rng.integers(len(centres)))
        way = rng.normal(size=3)
        radius = radii[host] * rng.uniform(0.4, 1.0)
        centres.append(centres[host] + way / np.linalg.norm(way) * (radii[host] + rng.uniform(-0.2, 0.5) * radius))
        radii.append(radius)
    middle = np.mean(centres, axis=0)
    extent = max(float(np.linalg.norm(centre - middle)) + radius for centre, radius in zip(centres, radii, strict=True))
    balls = [sdf.ball((c - middle) / extent, r / extent) for c, r in zip(centres, radii, strict=True)]
    solid = sdf.warp(sdf.union(balls, rng.uniform(0.08, 0.35)), vector_waves(rng, 1.5, 4), rng.uniform(0.0, 0.12))
    frequency = np.exp(rng.uniform(np.log(4), np.log(11)))
    waves = scalar_waves(rng, frequency, frequency * rng.uniform(1.2, 2.5))
    relief = sdf.furrows(waves, 0.4) if rng.random() < 0.4 else waves
    return sdf.displace(solid, relief, rng.uniform(0.0, 0.3) / frequency)


def displace_sphere(rng: np.random.Generator, parameters: BlobParameters) -> TriangleMesh:
    """Displace and carry the unit sphere; normals are exact, from tangents pushed through every map.

    Args:
        rng: Source of the noise.
        parameters: Strengths and scales of the maps.
    """
    base, faces, first, second = _sphere_frame()
    points, tangents = _displace(rng, parameters, base, [first, second])
    points, tangents = _carry(rng, parameters, points, tangents)
    return TriangleMesh(vertices=points.T, faces=faces, normals=unit(np.cross(tangents[0], tangents[1], axis=0).T))


def _displace(
    rng: np.random.Generator, parameters: BlobParameters, base: np.ndarray, tangents: list[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Map n to n exp(a g(n)) stretched along the axes, with its tangents; stays free of self-intersections."""
    low = parameters.frequency
    field = scalar_waves(rng, low, low * parameters.bandwidth, count=24, slope=parameters.slope)
    value, slopes = field.with_derivatives(base, tangents)  # (1, V)
    # |n| rounded off at 0.15, so that creases stay smooth at the density of the mesh.
    fold = np.sqrt(value**2 + 0.15**2)
    share = abs(parameters.crease)
    sign = -np.sign(parameters.crease)
    log_radius = parameters.lumpiness * ((1 - share) * value + share * sign * 1.6 * fold)
    gain = parameters.lumpiness * ((1 - share) + share * sign * 1.6 * value / fold)
    radius = np.exp(log_radius)
    stretch = np.array(parameters.stretch, np.float32)[:, None]
    pairs = zip(tangents, slopes, strict=True)
    moved = [radius * (tangent + base * (gain * slope)) * stretch for tangent, slope in pairs]
    return radius * base * stretch, moved


def _carry(
    rng: np.random.Generator, parameters: BlobParameters, points: np.ndarray, tangents: list[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Carry points and tangents along a smooth flow in steps small enough that each is one-to-one."""
    if not parameters.flow:
        return points, tangents
    low = parameters.flow_frequency
    field = vector_waves(rng, low, 2 * low, count=12, slope=1.5)
    step = np.float32(parameters.flow / FLOW_STEPS)
    for _ in range(FLOW_STEPS):
        velocity, slopes = field.with_derivatives(points, tangents)
        points = points + step * velocity
        tangents = [tangent + step * slope for tangent, slope in zip(tangents, slopes, strict=True)]
    return points, tangents


@cache
def _sphere_frame() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit sphere's vertices, faces, and two tangents with first x second = outward normal."""
    sphere = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    points = unit(np.asarray(sphere.vertices))
    axis = np.where(np.abs(points[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = unit(np.cross(axis, points))
    second = np.cross(points, first)
    faces = np.asarray(sphere.faces, dtype=np.uint32)
    frame = [np.ascontiguousarray(rows.T, dtype=np.float32) for rows in (points, first, second)]  # each (3, V)
    return frame[0], faces, frame[1], frame[2]
