"""Cloth: fold patterns, garments over a body, and hanging drapery, as signed distance fields."""

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture.bodies import Pose


def folds(rng: np.random.Generator, spacing: float, *, tilt: float = 0.25) -> Field:
    """Draw a pattern of folds: rounded ridges between furrows, roughly vertical, bent and branching.

    Args:
        rng: Source of the noise.
        spacing: Mean distance between furrows.
        tilt: Standard deviation of the slant from the vertical, as horizontal over vertical.
    """
    number = np.pi / spacing  # furrows lie where the noise is zero, twice per wave
    way = np.array([rng.normal(0, tilt), 1.0, rng.normal(0, tilt)])
    waves = scalar_waves(rng, 0.75 * number, 1.3 * number, count=10, slope=0)
    waves = waves.stretch(way / np.linalg.norm(way), np.exp(rng.uniform(np.log(6), np.log(24))))
    kind = rng.random()
    if kind < 0.35:
        pattern = sdf.furrows(waves, rng.uniform(0.15, 0.5))  # full lobes, as of heavy wool
    elif kind < 0.65:
        pattern = sdf.invert(sdf.furrows(waves, rng.uniform(0.2, 0.5)))  # narrow tubes, as of thin linen
    else:
        pattern = waves
    return sdf.warp(pattern, vector_waves(rng, 1.5, 4.5, count=8), rng.uniform(0.04, 0.2))


def gather(relief: Field, centre: sdf.Vector, radius: float) -> Field:
    """Let the folds run together where the cloth is narrower than `radius` about the vertical through `centre`."""
    centre = sdf.column(centre)
    keep = np.array([[0], [1], [0]], np.float32)

    def pattern(p: np.ndarray) -> np.ndarray:
        q = p - centre
        spread = np.float32(radius) / np.maximum(np.hypot(q[0], q[2]), np.float32(0.02))
        return relief(q * (keep + (1 - keep) * spread))

    return pattern


def pleat(
    rng: np.random.Generator, cloth: Field, *, top: float, bottom: float, axis: sdf.Vector | None = None
) -> Field:
    """Put broad and fine folds on `cloth`, deepening from `top` (y) down to `bottom`.

    With an `axis`, a point on it, the broad folds may radiate from the vertical through that point.
    """
    spacing = float(np.exp(rng.uniform(np.log(0.1), np.log(0.28))))
    broad, fine = folds(rng, spacing), folds(rng, rng.uniform(0.06, 0.12), tilt=0.6)
    if axis is not None and rng.random() < 0.6:
        broad = gather(broad, axis, 0.3)
    height = np.float32(max(top - bottom, 1e-3))

    def deepening(p: np.ndarray) -> np.ndarray:
        return broad(p) * np.clip(0.4 + 0.6 * (np.float32(top) - p[1]) / height, 0.4, 1.1)

    cloth = sdf.displace(cloth, deepening, spacing * rng.uniform(0.14, 0.38))
    return sdf.displace(cloth, fine, np.exp(rng.uniform(np.log(0.001), np.log(0.008))))


def skirt(rng: np.random.Generator, pose: Pose) -> Field:
    """Build a long skirt or robe from the waist down: cloth stretched between the legs, flared, with a wavy hem."""
    width = rng.uniform(1.0, 1.35)
    ankles = [joints[2] for joints in pose.legs]
    foot = np.mean(ankles, axis=0)
    parts = [sdf.ellipsoid(pose.pelvis, np.array([0.19, 0.2, 0.15]) * width, pose.pelvis_turn)]
    for joints in pose.legs:
        parts.append(sdf.cone(joints[0], joints[1], 0.13 * width, 0.12 * width))
        parts.append(sdf.cone(joints[1], joints[2], 0.12 * width, 0.15 * width))
    hem_point = [foot[0], min(ankle[1] for ankle in ankles) - 0.05, foot[2]]
    parts.append(sdf.cone(pose.pelvis, hem_point, 0.14, rng.uniform(0.16, 0.34)))
    hem = hem_point[1] + rng.choice([0.0, 0.05, rng.uniform(0.1, 0.45)])
    cloth = pleat(rng, sdf.union(parts, rng.uniform(0.12, 0.3)), top=0.1, bottom=hem, axis=pose.waist)
    waves = scalar_waves(rng, 3, 9, count=8)
    floor = sdf.displace(sdf.halfspace([0, -1, 0], -hem), waves, rng.uniform(0.0, 0.03))
    return sdf.intersection([cloth, floor], 0.02)


def tunic(rng: np.random.Generator, pose: Pose) -> Field:
    """Build a loose upper garment, with sleeves to the elbow at times, and a girdle or a sash."""
    parts = [
        sdf.ellipsoid(pose.chest, [0.185, 0.2, 0.145], pose.chest_turn),
        sdf.ellipsoid(pose.waist, [0.155, 0.2, 0.125], pose.chest_turn),
        sdf.ellipsoid(pose.pelvis, [0.18, 0.14, 0.14], pose.pelvis_turn),
        sdf.cone(pose.arms[0][0], pose.arms[1][0], 0.085, 0.085),
    ]
    if rng.random() < 0.6:
        reach = rng.uniform(0.3, 1.0)
        for joints in pose.arms:
            parts.append(sdf.cone(joints[0], joints[0] + reach * (joints[1] - joints[0]), 0.095, 0.11))
    cloth = pleat(rng, sdf.union(parts, 0.12), top=pose.neck[1], bottom=pose.pelvis[1])
    slant = pose.chest_turn @ sdf.rotation("z", rng.choice([0.0, rng.uniform(-50, 50)]))
    girdle = sdf.torus(pose.waist, 0.135, rng.uniform(0.025, 0.06), slant)
    return sdf.union([cloth, sdf.displace(girdle, folds(rng, 0.06, tilt=3), 0.012)], 0.03)


def mantle(rng: np.random.Generator, pose: Pose, *, hooded: bool) -> Field:
    """Build a cloak hanging from the shoulders, or from the head, down the back and one side."""
    side = rng.choice([-1, 1])
    start = [joints[0] for joints in pose.arms]
    back = pose.chest_turn @ [0, 0, -1]
    fall = np.array([0, -1, 0]) * rng.uniform(0.5, 1.2)
    parts = [sdf.cone(start[0], start[1], 0.1, 0.1)]
    for shoulder in (*start, pose.neck):
        parts.append(sdf.cone(shoulder + 0.03 * back, shoulder + 0.12 * back + fall, 0.1, rng.uniform(0.1, 0.2)))
    outer = pose.arms[0 if side > 0 else 1]
    parts.append(sdf.cone(outer[0], outer[1], 0.11, 0.1))
    parts.append(sdf.cone(outer[1], outer[1] + 0.6 * fall, 0.1, 0.12))
    if hooded:
        nape = pose.head - 0.03 * pose.head_turn[:, 2]
        parts.append(sdf.ellipsoid(nape, [0.135, 0.165, 0.145], pose.head_turn))
        parts.append(sdf.cone(pose.head, pose.neck, 0.12, 0.1))
    cloth = pleat(rng, sdf.union(parts, 0.14), top=pose.neck[1], bottom=pose.neck[1] + fall[1])
    if hooded:
        face = pose.head + pose.head_turn @ [0, -0.02, 0.14]
        cloth = sdf.subtraction(cloth, sdf.ellipsoid(face, [0.085, 0.125, 0.12], pose.head_turn), 0.03)
    return cloth


def hanging_cloth(rng: np.random.Generator) -> Field:
    """Build free drapery: a curtain gathered at two or three points, with swags between them, or a draped column."""
    if rng.random() < 0.45:
        profile = scalar_waves(rng, 1.5, 4, count=6)
        knot, foot = rng.uniform(0.12, 0.35), rng.uniform(0.35, 0.65)
        body = sdf.union([sdf.ball([0, 0.85, 0], knot * 1.2), sdf.cone([0, 0.8, 0], [0, -0.9, 0], knot, foot)], 0.1)
        body = sdf.displace(body, profile, 0.06)
        cloth = pleat(rng, pleat(rng, body, top=0.9, bottom=-0.9, axis=[0, 0, 0]), top=0.9, bottom=-0.9)
        cloth = sdf.intersection([cloth, sdf.halfspace([0, -1, 0], 0.9), sdf.halfspace([0, 1, 0], 1.05)], 0.03)
        return sdf.twist(cloth, rng.normal(0, 0.8))
    return _curtain(rng)


def _curtain(rng: np.random.Generator) -> Field:
    """Build a panel of cloth pinned at two or three points along its top, with swags between the pins."""
    pins = np.sort(rng.uniform(-0.6, 0.6, rng.integers(2, 4))).astype(np.float32)
    swag, count, depth = np.float32(rng.uniform(0.25, 0.8)), np.float32(rng.uniform(9, 18)), rng.uniform(0.06, 0.14)
    sway, wavy = vector_waves(rng, 2, 5, count=8), scalar_waves(rng, 1.5, 4, count=6)

    def cloth(p: np.ndarray) -> np.ndarray:
        # Folds of a swag follow curves of equal distance from its pins.
        q = p + np.float32(0.06) * sway(p)
        away = np.minimum.reduce([np.hypot(q[0] - x, np.float32(0.6) * (q[1] - np.float32(0.8))) for x in pins])
        phase = count * (away * swag + (1 - swag) * np.abs(q[0]))
        front = np.float32(depth) * (np.sqrt(np.sin(phase) ** 2 + np.float32(0.04)) + wavy(p))
        return (p[2] - front) * np.float32(0.6)

    panel = sdf.displace(cloth, folds(rng, rng.uniform(0.08, 0.2), tilt=0.6), rng.uniform(0.003, 0.025))
    frame = sdf.displace(sdf.box([0, 0, 0.3], [0.8, 0.9, 0.6], 0.1), wavy, 0.05)
    return sdf.intersection([panel, frame], 0.04)
