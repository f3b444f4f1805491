"""Animals: four-legged bodies of random build and pose, with fur, as signed distance fields."""

from itertools import pairwise

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture import drapery


def animal(rng: np.random.Generator) -> Field:
    """Build one animal facing +x: standing, sitting on its haunches or lying, smooth-skinned or furred."""
    stance = rng.choice(["stand", "sit", "lie"])
    pitch = np.radians({"stand": rng.uniform(-8, 12), "sit": rng.uniform(25, 60), "lie": rng.uniform(-3, 15)}[stance])
    half, girth = rng.uniform(0.28, 0.48), rng.uniform(0.17, 0.3)
    way = np.array([np.cos(pitch), np.sin(pitch), 0])
    hips, chest = -half * way, half * way
    trunk = [
        sdf.cone(hips, chest, girth * rng.uniform(0.85, 1.2), girth * rng.uniform(0.9, 1.15)),
        sdf.ball(-0.1 * half * way - [0, rng.uniform(0, 0.1), 0], girth * rng.uniform(0.95, 1.2)),
    ]
    neck_end, skull = _neck_and_head(rng, chest, girth)
    trunk.append(sdf.cone(chest, neck_end, girth * rng.uniform(0.6, 0.85), girth * rng.uniform(0.35, 0.55)))
    reach = rng.uniform(0.35, 1.0) * (half + girth)
    legs = [_leg(rng, hips, chest, girth, reach, stance, side, fore=fore) for side in (1, -1) for fore in (True, False)]
    coat = sdf.union([sdf.union(trunk, 0.15), *legs], rng.uniform(0.05, 0.12))
    coat = sdf.union([coat, _tail(rng, hips, girth)], 0.06)
    solid = _add_fur(rng, sdf.union([coat, skull], 0.08))
    if rng.random() < 0.4:
        floor = -reach - 0.6 * girth if stance == "stand" else hips[1] - girth
        base = sdf.box([0, floor - 0.05, 0], [half + 0.35, 0.08, girth + 0.2], 0.02)
        solid = sdf.union([solid, base], 0.03)
    return solid


def _neck_and_head(rng: np.random.Generator, chest: np.ndarray, girth: float) -> tuple[np.ndarray, Field]:
    """Place the head; returns where the neck ends, and the head with muzzle, ears, eyes and perhaps horns."""
    rise, size = np.radians(rng.uniform(5, 80)), girth * rng.uniform(0.6, 1.0)
    yaw = rng.normal(0, 35)
    extent = girth * rng.uniform(0.6, 2.2)
    centre = chest + extent * np.array([np.cos(rise), np.sin(rise), 0.3 * np.sin(np.radians(yaw))])
    frame = sdf.rotation("yz", -yaw, rng.uniform(-40, 15))
    snout, thick = rng.uniform(0.7, 1.7), rng.uniform(0.3, 0.6)
    parts = [
        sdf.ellipsoid([0, 0, 0], [1.05, 0.9, rng.uniform(0.7, 0.95)]),
        sdf.cone([0.4, -0.15, 0], [snout, -0.35, 0], thick * 1.2, thick * 0.8),
        sdf.ellipsoid([0.3, -0.4, 0], [0.7, 0.35, 0.4]),
    ]
    skull = sdf.union(parts, 0.35)
    length, spread, back = rng.uniform(0.5, 2.0), rng.uniform(10, 75), rng.uniform(-20, 60)
    for side in (1, -1):
        skull = sdf.subtraction(skull, sdf.ball([0.75, 0.3, 0.62 * side], 0.2), 0.15)
        skull = sdf.union([skull, sdf.ball([0.62, 0.28, 0.52 * side], 0.19)], 0.05)
        ear = sdf.ellipsoid([0, length / 2, 0], [0.22, length / 2 + 0.1, 0.34])
        ear = sdf.subtraction(ear, sdf.ellipsoid([0.22, length / 2 + 0.05, 0], [0.18, length / 2 - 0.1, 0.22]), 0.1)
        lie = sdf.rotation("xz", side * spread, back + rng.normal(0, 8))
        skull = sdf.union([skull, sdf.place(ear, [-0.25, 0.55, 0.4 * side], lie)], 0.15)
        if rng.random() < 0.15:
            tip = np.array([-0.2, 1.9, 0.9 * side])
            skull = sdf.union([skull, sdf.cone([0.1, 0.7, 0.35 * side], tip, 0.2, 0.06)], 0.1)
    skull = sdf.subtraction(skull, sdf.box([snout, -0.35 - thick * 0.35, 0], [0.6, 0.03, 1], 0.02), 0.05)
    return centre, sdf.bound(sdf.place(skull, centre, frame, size), centre, 3.2 * size)


def _leg(
    rng: np.random.Generator,
    hips: np.ndarray,
    chest: np.ndarray,
    girth: float,
    reach: float,
    stance: str,
    side: int,
    *,
    fore: bool,
) -> Field:
    """Build a leg of two bones and a paw; folded under the body where the animal lies or sits."""
    root = (chest if fore else hips) + [0, -0.25 * girth, 0.62 * girth * side]
    thick = girth * rng.uniform(0.28, 0.42)
    folded = stance == "lie" or (stance == "sit" and not fore)
    if folded:
        floor = hips[1] - 0.85 * girth
        knee = root + np.array([0.9, -0.35, 0.35 * side]) * girth
        ankle = np.array([root[0] + (-0.1 if not fore else 0.5) * girth, floor, knee[2]])
        paw = ankle + np.array([1.2, 0, 0.1 * side]) * girth
        muscle = thick * (1.9 if not fore else 1.3)
    else:
        floor = min(-reach - 0.3 * girth, hips[1] - 0.85 * girth) if stance == "sit" else root[1] - reach
        swing = rng.normal(0, 0.18)
        knee = root + np.array([(-0.08 if fore else 0.12) + swing * 0.4, 0.48 * (floor - root[1]), 0])
        ankle = np.array([root[0] + swing, floor, root[2]])
        paw = ankle + np.array([0.55, -0.05, 0]) * girth
        muscle = thick * (1.7 if not fore else 1.35)
    parts = [
        sdf.cone(root, knee, muscle, thick),
        sdf.cone(knee, ankle, thick * 0.95, thick * 0.7),
        sdf.cone(ankle, paw, thick * 0.75, thick * 0.85),
    ]
    joints = np.stack([root, knee, ankle, paw])
    centre = joints.mean(axis=0)
    radius = float(np.linalg.norm(joints - centre, axis=1).max()) + muscle
    return sdf.bound(sdf.union(parts, 0.06), centre, radius)


def _tail(rng: np.random.Generator, hips: np.ndarray, girth: float) -> Field:
    """Build a stub or a curved tail behind the hips."""
    joints = [hips + np.array([-0.85, 0.25, 0]) * girth]
    angle, thick = np.radians(rng.uniform(90, 230)), girth * rng.uniform(0.15, 0.4)
    for _ in range(int(rng.integers(1, 5))):
        joints.append(joints[-1] + 0.14 * np.array([np.cos(angle), np.sin(angle), rng.normal(0, 0.3)]))
        angle += rng.normal(0, 0.6)
    return sdf.union([sdf.cone(a, b, thick, thick * 0.9) for a, b in pairwise(joints)], 0.05)


def _add_fur(rng: np.random.Generator, solid: Field) -> Field:
    """Give the animal a skin: lumps of muscle, and over them short fur, tufts or a fleece."""
    solid = sdf.displace(solid, scalar_waves(rng, 7, 20, count=20), rng.uniform(0.004, 0.014))
    coat = rng.random()
    if coat < 0.3:
        return sdf.displace(solid, drapery.folds(rng, rng.uniform(0.04, 0.07), tilt=2.0), rng.uniform(0.003, 0.01))
    if coat < 0.65:
        tufts = sdf.furrows(scalar_waves(rng, 22, 50, count=20, slope=0.5), 0.3)
        return sdf.displace(sdf.warp(solid, vector_waves(rng, 4, 9), 0.015), tufts, rng.uniform(0.004, 0.014))
    return sdf.displace(solid, scalar_waves(rng, 25, 70, count=24), rng.uniform(0.001, 0.004))
