"""What the objects of a composition stand on or in: grounds, corners, bowls, niches, as signed distance fields.

y is up; what opens to a side opens towards +z.
"""

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves
from render.shapes.geometry.sdf import Field

THICKNESS = 0.08  # of half a slab


def ground(rng: np.random.Generator) -> Field:
    """Build a slab, round or square, its top at y = 0: flat, or uneven as trodden earth."""
    size = rng.uniform(0.85, 1.05)
    if rng.random() < 0.5:
        slab = sdf.cylinder([0, -THICKNESS, 0], size, THICKNESS, 0.03)
    else:
        slab = sdf.box([0, -THICKNESS, 0], [size, THICKNESS, size * rng.uniform(0.8, 1)], 0.03)
    if rng.random() < 0.4:
        slab = sdf.displace(slab, scalar_waves(rng, 2, 25, slope=1.5), rng.uniform(0.005, 0.02))
    return slab


def corner(rng: np.random.Generator) -> Field:
    """Build a ground with a wall behind it, or with two walls, and at times a hollow curve where they meet."""
    half, height, wall = rng.uniform(0.75, 0.95), rng.uniform(0.5, 0.8), THICKNESS
    slabs = [
        sdf.box([0, -wall, 0], [half, wall, half], 0.02),
        sdf.box([0, height - 2 * wall, -half + wall], [half, height, wall], 0.02),
    ]
    if rng.random() < 0.5:
        slabs.append(sdf.box([-half + wall, height - 2 * wall, 0], [wall, height, half], 0.02))
    stage = sdf.union(slabs, rng.choice([0.02, 0.1]))
    if rng.random() < 0.4:
        stage = sdf.displace(stage, scalar_waves(rng, 3, 30, slope=1.3), rng.uniform(0.004, 0.015))
    return stage


def bowl(rng: np.random.Generator) -> Field:
    """Build a bowl or dish on a foot, its rim at y = 0 and of radius 1 outside, round or with a waved wall."""
    wall, depth = rng.uniform(0.04, 0.09), rng.uniform(0.45, 0.95)
    outside = sdf.squeeze(sdf.ball([0, 0, 0], 1.0), [1, depth, 1])
    inside = sdf.squeeze(sdf.ball([0, 0, 0], 1 - wall), [1, (depth - wall) / (1 - wall), 1])
    shell = sdf.subtraction(outside, inside)
    lobes, amount = int(rng.integers(5, 13)), rng.choice([0.0, rng.uniform(0.01, 0.03)])
    below = sdf.halfspace([0, 1, 0], 0.0)
    half = sdf.intersection([shell, below], 0.02)

    def waved(p: np.ndarray) -> np.ndarray:
        grow = 1 + np.float32(amount) * np.cos(np.float32(lobes) * np.arctan2(p[2], p[0]))
        return half(np.stack([p[0] * grow, p[1], p[2] * grow]))

    foot = sdf.cylinder([0, -depth - 0.01, 0], 0.4, 0.07, 0.02)
    return sdf.union([waved, foot], 0.04)


def niche(rng: np.random.Generator) -> Field:
    """Build a block with a recess, an arch or a square one, over a floor (y = 0) that comes out to the front."""
    radius, high, deep = rng.uniform(0.45, 0.6), rng.uniform(0.7, 1.0), rng.uniform(0.45, 0.65)
    top = high + radius + rng.uniform(0.15, 0.3)
    block = sdf.box([0, top / 2 - THICKNESS, -deep / 2], [radius + 0.3, top / 2 + THICKNESS, deep / 2 + 0.12], 0.03)
    if rng.random() < 0.6:  # an apse: half a cylinder under a quarter of a ball
        hollow = sdf.union([
            sdf.squeeze(sdf.cylinder([0, 2, 0], radius, 2), [1, high / 4, deep / radius]),
            sdf.place(sdf.squeeze(sdf.ball([0, 0, 0], radius), [1, 1, deep / radius]), [0, high, 0]),
        ])  # fmt: skip
        front = sdf.box([0, high / 2, 0.5], [radius, high / 2, 0.5])
        hollow = sdf.union([hollow, front])
    else:
        hollow = sdf.box([0, (high + radius) / 2, 0.4], [radius, (high + radius) / 2, deep + 0.4], 0.02)
    floor = sdf.box([0, -THICKNESS, 0.3], [radius + 0.3, THICKNESS, 0.65], 0.02)
    stage = sdf.union([sdf.subtraction(block, hollow, 0.02), floor])
    if rng.random() < 0.4:
        stage = sdf.displace(stage, scalar_waves(rng, 4, 30, slope=1.3), rng.uniform(0.003, 0.012))
    return stage


def hollow(rng: np.random.Generator) -> Field:
    """Build one deeply concave object: a shell with windows, a block full of tunnels, or a scroll."""
    return (shell, tunnels, scroll)[int(rng.integers(3))](rng)


def shell(rng: np.random.Generator) -> Field:
    """Build a thick shell with round windows through which its inside is seen."""
    size, wall = np.exp(rng.normal(0, 0.12, 3)), rng.uniform(0.05, 0.12)
    body = sdf.squeeze(sdf.ball([0, 0, 0], 1.0), size / size.max())
    solid = sdf.subtraction(body, lambda p: body(p) + np.float32(wall), 0.02)
    for way in _ways(rng, int(rng.integers(2, 7))):
        solid = sdf.subtraction(solid, sdf.cone([0, 0, 0], 1.2 * way, 0.05, rng.uniform(0.3, 0.65)), 0.04)
    return solid


def tunnels(rng: np.random.Generator) -> Field:
    """Build a block or ball with deep tunnels that meet inside."""
    body = sdf.ball([0, 0, 0], 1.0)
    if rng.random() < 0.5:
        body = sdf.box([0, 0, 0], rng.uniform(0.65, 0.9, 3), 0.08)
    for way in _ways(rng, int(rng.integers(4, 10))):
        start = rng.normal(0, 0.15, 3)
        body = sdf.subtraction(body, sdf.cone(start, 1.3 * way, rng.uniform(0.1, 0.25), rng.uniform(0.2, 0.4)), 0.05)
    return body


def scroll(rng: np.random.Generator) -> Field:
    """Build a rolled sheet, seen into from its ends and its side."""
    gap, wall, turns = rng.uniform(0.22, 0.36), rng.uniform(0.035, 0.06), rng.uniform(1.3, 2.4)
    height = rng.uniform(0.5, 0.9)

    def sheet(p: np.ndarray) -> np.ndarray:
        angle, radius = np.arctan2(p[2], p[0]) / np.float32(2 * np.pi), np.hypot(p[0], p[2])
        # The winding nearest in radius, among those the sheet has.
        winding = np.clip(np.round(radius / np.float32(gap) - angle), 0, None)
        along = np.clip(winding + angle, np.float32(0.25), np.float32(0.25 + turns))
        turn = 2 * np.pi * along
        nearest = np.stack([np.cos(turn), np.sin(turn)]) * along * np.float32(gap)
        return (np.hypot(p[0] - nearest[0], p[2] - nearest[1]) - np.float32(wall)).astype(np.float32)

    ends = sdf.box([0, 0, 0], [3, height, 3])
    return sdf.intersection([sheet, ends], 0.02)


def _ways(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw unit vectors (count, 3), most of them towards +z and up, where they are seen."""
    ways = rng.normal(size=(count, 3)) + np.array([0, 0.4, 0.8])
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)
