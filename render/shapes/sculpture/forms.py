"""Recipes without a body: vessels, rocks, and abstract forms of tubes, rings and blocks, as signed distance fields."""

import numpy as np
from scipy.interpolate import CubicSpline

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture.bodies import turn


def vessel(rng: np.random.Generator) -> Field:
    """Build an urn, vase or cup: a turned hollow body with flutes or carved relief, at times with handles."""
    heights = np.array([-1.0, -0.85, -0.45, 0.1, 0.5, 0.75, 1.0])
    radii = np.array([0.36, 0.22, 0.55, 0.68, 0.45, 0.32, 0.45]) * np.exp(rng.normal(0, 0.15, 7))
    profile = CubicSpline(heights, np.maximum(radii, 0.12))
    slope = profile.derivative()
    flutes, depth = (int(rng.integers(8, 28)), rng.uniform(0.01, 0.035)) if rng.random() < 0.4 else (0, 0.0)

    def outside(p: np.ndarray) -> np.ndarray:
        height = np.clip(p[1], -1, 1)
        radius = profile(height).astype(np.float32)
        if flutes:
            band = np.clip(4 * (0.7 - np.abs(height)), 0, 1)
            around = np.sin(np.float32(flutes / 2) * np.arctan2(p[2], p[0]))
            # Arrises between the flutes are rounded to a few cells: sharper ones would come out ragged.
            radius = radius - np.float32(depth) * band * np.sqrt(around**2 + np.float32(0.04))
        return (np.hypot(p[0], p[2]) - radius) / np.sqrt(1 + slope(height).astype(np.float32) ** 2)

    body = sdf.intersection([outside, sdf.box([0, 0, 0], [2, 1, 2])], 0.03)
    relief = scalar_waves(rng, 8, 28, count=24)
    reliefs: list[Field] = [relief, sdf.furrows(relief, 0.3), sdf.cracks(relief, 0.5)]
    carved = reliefs[rng.integers(3)]
    height = rng.choice([0.0, rng.uniform(0.005, 0.03)])
    body = sdf.displace(body, carved, height)
    # The wall must outlast the deepest hollow of the relief, about three standard deviations.
    wall = np.float32(0.06 + 3 * height)
    cavity = sdf.intersection([lambda p: outside(p) + wall, sdf.halfspace([0, -1, 0], 0.6)], 0.05)
    body = sdf.subtraction(body, cavity, 0.03)
    for band in rng.uniform(-0.8, 0.95, rng.integers(0, 4)):
        body = sdf.union([body, sdf.torus([0, band, 0], float(profile(band)), rng.uniform(0.02, 0.05))], 0.02)
    if rng.random() < 0.55:
        for side in (1, -1)[: int(rng.integers(1, 3))]:
            x = side * float(profile(0.45))
            arch = sdf.torus([x, 0.42, 0], rng.uniform(0.2, 0.3), rng.uniform(0.035, 0.06), sdf.rotation("x", 90))
            body = sdf.union([body, sdf.subtraction(arch, lambda p: outside(p) + np.float32(0.035))], 0.04)
    return body


def rock(rng: np.random.Generator) -> Field:
    """Build a stone: a hull of random cuts, sharp or worn, with lumps, strata, cracks and hollows."""
    size = np.exp(rng.normal(0, 0.2, 3))
    cuts = [sdf.halfspace(normal, rng.uniform(0.55, 0.9)) for normal in _directions(rng, int(rng.integers(7, 22)))]
    hull = sdf.intersection([sdf.ball([0, 0, 0], 1.0), *cuts], rng.choice([0.0, 0.03, 0.12, 0.3]))
    stone = sdf.squeeze(hull, 0.8 * size / size.max())
    stone = sdf.warp(stone, vector_waves(rng, 1.5, 5), rng.uniform(0.02, 0.15))
    for centre in _directions(rng, int(rng.integers(0, 5))):
        stone = sdf.subtraction(stone, sdf.ball(0.7 * centre, rng.uniform(0.15, 0.4)), rng.uniform(0.02, 0.15))
    if rng.random() < 0.4:
        strata = scalar_waves(rng, 10, 30, count=10, slope=0.5)
        axis, spread = _directions(rng, 1)[0], rng.uniform(4, 10)
        for way in np.linalg.svd(axis[None])[2][1:]:  # the two directions within a layer
            strata = strata.stretch(way, spread)
        stone = sdf.displace(stone, strata, rng.uniform(0.01, 0.03))
    if rng.random() < 0.5:
        lines = sdf.cracks(scalar_waves(rng, 3, 8), rng.uniform(0.08, 0.2))
        stone = sdf.displace(stone, lines, rng.uniform(0.02, 0.05))
    grain = scalar_waves(rng, 6, 50, count=32, slope=rng.uniform(0.8, 1.4))
    return sdf.displace(stone, grain, rng.uniform(0.006, 0.04))


def abstract(rng: np.random.Generator) -> Field:
    """Build an abstract carving: knotted tubes, linked rings, or blocks and bars pierced by holes, twisted and bent."""
    kind = rng.integers(3)
    if kind == 0:
        form = knot(rng)
    elif kind == 1:
        rings = [
            sdf.torus(rng.normal(0, 0.3, 3), rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.24), turn(rng, 60))
            for _ in range(int(rng.integers(2, 6)))
        ]
        form = sdf.union(rings, rng.uniform(0.02, 0.2))
    else:
        solids = [_solid(rng) for _ in range(int(rng.integers(4, 10)))]
        form = sdf.union(solids, rng.choice([0.0, 0.04, 0.15]))
        for _ in range(int(rng.integers(1, 4))):
            hole = sdf.place(sdf.cylinder([0, 0, 0], rng.uniform(0.1, 0.22), 2), rng.normal(0, 0.2, 3), turn(rng, 60))
            form = sdf.subtraction(form, hole, rng.choice([0.01, 0.08]))
    if kind > 0:
        form = sdf.bend(sdf.twist(form, rng.normal(0, 0.9)), rng.normal(0, 0.2), rng.uniform(0, np.pi))
    if rng.random() < 0.5:
        waves = scalar_waves(rng, 10, 35, count=20)
        form = sdf.displace(form, sdf.furrows(waves, 0.3) if rng.random() < 0.5 else waves, rng.uniform(0.003, 0.015))
    return form


def knot(rng: np.random.Generator) -> Field:
    """Build a tube of varying thickness along a closed random or torus-knot curve."""
    if rng.random() < 0.5:
        turns, loops = [(2, 3), (3, 2), (2, 5), (3, 4), (1, 3), (1, 2)][rng.integers(6)]
        harmonics = np.zeros((3, loops + turns + 1), dtype=complex)
        # ((0.55 + 0.25 cos qt) cos pt, 0.25 sin qt, (0.55 + 0.25 cos qt) sin pt) as complex Fourier series
        for order, weight in ((turns, 0.55), (turns + loops, 0.125), (abs(turns - loops), 0.125)):
            sense = 1 if order != loops - turns else -1
            harmonics[0, order] += weight
            harmonics[2, order] += -1j * weight * sense
        harmonics[1, loops] = -0.25j
    else:
        orders = np.arange(1, 5)
        harmonics = np.zeros((3, 5), dtype=complex)
        harmonics[:, 1:] = (rng.normal(size=(3, 4)) + 1j * rng.normal(size=(3, 4))) * 0.4 / orders**1.2
    thick, swell, beats = rng.uniform(0.09, 0.2), rng.uniform(0, 0.4), int(rng.integers(1, 9))
    return tube(harmonics, lambda t: np.float32(thick) * (1 + np.float32(swell) * np.sin(np.float32(beats) * t)))


def tube(harmonics: np.ndarray, radius: Field) -> Field:
    """Distance to the tube of `radius(t)` around the curve Re sum_k harmonics[:, k] exp(i k t)."""
    order = np.flatnonzero(np.abs(harmonics).max(axis=0) > 0)
    scaled = [(harmonics[:, order] * (1j * order) ** derivative).astype(np.complex64) for derivative in range(3)]
    order = order[:, None].astype(np.float32)
    count = 96

    def curve(t: np.ndarray, *derivatives: int) -> list[np.ndarray]:
        cosine, sine = np.cos(order * t), np.sin(order * t)
        return [scaled[k].real @ cosine - scaled[k].imag @ sine for k in derivatives]  # each (3, N)

    knots = np.linspace(0, 2 * np.pi, count, endpoint=False).astype(np.float32)
    (points,) = curve(knots, 0)
    squared = (points**2).sum(axis=0)[:, None]

    def field(p: np.ndarray) -> np.ndarray:
        t = knots[(squared - 2 * (points.T @ p)).argmin(axis=0)]
        for _ in range(2):  # Newton steps on (c(t) - p) . c'(t) = 0 from the nearest knot
            centre, velocity, acceleration = curve(t, 0, 1, 2)
            offset = centre - p
            bend = ((velocity**2) + offset * acceleration).sum(axis=0)
            t = t - np.clip((offset * velocity).sum(axis=0) / np.maximum(bend, np.float32(1e-3)), -0.06, 0.06)
        return sdf.length(curve(t, 0)[0] - p) - radius(t)

    return field


def _solid(rng: np.random.Generator) -> Field:
    """Return a random box, ellipsoid or bar near the centre."""
    centre, rotation = rng.normal(0, 0.32, 3), turn(rng, 50)
    kind = rng.integers(3)
    if kind == 0:
        return sdf.box(centre, rng.uniform(0.12, 0.4, 3), rng.uniform(0.01, 0.08), rotation)
    if kind == 1:
        return sdf.ellipsoid(centre, rng.uniform(0.15, 0.45, 3), rotation)
    end = centre + rng.normal(0, 0.45, 3)
    return sdf.cone(centre, end, rng.uniform(0.1, 0.22), rng.uniform(0.06, 0.2))


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw unit vectors, (count, 3)."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
