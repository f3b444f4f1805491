"""Articulated human bodies in random poses, as signed distance fields.

Lengths are in units where a standing body is about 2 high (eight heads); y is up and the body faces +z.
"""

from dataclasses import dataclass

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture.heads import head

DOWN = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Joint positions of a body, each (3,), and the turns (3, 3) of its rigid parts."""

    pelvis: np.ndarray
    waist: np.ndarray
    chest: np.ndarray
    neck: np.ndarray
    head: np.ndarray
    arms: tuple[np.ndarray, np.ndarray]  # each (4, 3): shoulder, elbow, wrist, fingertips
    legs: tuple[np.ndarray, np.ndarray]  # each (4, 3): hip, knee, ankle, toes
    pelvis_turn: np.ndarray
    chest_turn: np.ndarray
    head_turn: np.ndarray


def turn(rng: np.random.Generator, degrees: float, axes: str = "yxz") -> np.ndarray:
    """Draw a rotation matrix (3, 3) with angles about `axes` normally distributed, `degrees` each."""
    return sdf.rotation(axes, *rng.normal(0, degrees, len(axes)))


def draw_pose(rng: np.random.Generator) -> Pose:
    """Draw a pose: standing, striding, kneeling or seated, with a turned trunk and free arms."""
    pelvis_turn = turn(rng, 10)
    chest_turn = pelvis_turn @ turn(rng, 16)
    head_turn = chest_turn @ turn(rng, 20)
    pelvis = np.zeros(3)
    waist = pelvis + pelvis_turn @ [0, 0.17, 0]
    chest = waist + chest_turn @ [0, 0.18, 0.01]
    neck = chest + chest_turn @ [0, 0.21, -0.01]
    head = neck + head_turn @ [0, 0.19, 0.03]
    stance = rng.choice(["stand", "stride", "kneel", "sit"], p=[0.45, 0.2, 0.15, 0.2])
    return Pose(
        pelvis=pelvis,
        waist=waist,
        chest=chest,
        neck=neck,
        head=head,
        arms=(_arm(rng, chest, chest_turn, 1), _arm(rng, chest, chest_turn, -1)),
        legs=(
            _leg(rng, pelvis, pelvis_turn, 1, stance, leading=True),
            _leg(rng, pelvis, pelvis_turn, -1, stance, leading=False),
        ),
        pelvis_turn=pelvis_turn,
        chest_turn=chest_turn,
        head_turn=head_turn,
    )


def _chain(start: np.ndarray, lengths: list[float], turns: list[np.ndarray], rest: list[np.ndarray]) -> np.ndarray:
    """Place joints one after another: each bone is `turn @ rest` long `length`; returns (bones + 1, 3)."""
    joints = [start]
    for size, rotation, way in zip(lengths, turns, rest, strict=True):
        joints.append(joints[-1] + size * (rotation @ way))
    return np.stack(joints)


def _arm(rng: np.random.Generator, chest: np.ndarray, chest_turn: np.ndarray, side: int) -> np.ndarray:
    """Draw an arm: raised sideways and forward by any amount, the elbow bent forward and inward."""
    lift = np.clip(abs(rng.normal(0, 45)), 12, 150)
    upper = chest_turn @ sdf.rotation("yz", -side * rng.uniform(-30, 110), side * lift)
    hinge = sdf.rotation("yx", rng.uniform(-80, 50) * side, -rng.uniform(5, 125))
    shoulder = chest + chest_turn @ [0.19 * side, 0.12, -0.01]
    lower = upper @ hinge
    return _chain(shoulder, [0.31, 0.26, 0.15], [upper, lower, lower @ turn(rng, 18)], [DOWN] * 3)


def _leg(
    rng: np.random.Generator, pelvis: np.ndarray, pelvis_turn: np.ndarray, side: int, stance: str, *, leading: bool
) -> np.ndarray:
    """Draw a leg: `raise` is the thigh forward, `bend` the knee back, `out` sideways, all in degrees."""
    ranges = {
        "stand": ((-5, 8), (0, 8)) if leading else ((5, 30), (10, 45)),
        "stride": ((20, 50), (5, 40)) if leading else ((-35, -10), (5, 40)),
        "kneel": ((75, 100), (80, 100)) if leading else ((-10, 10), (80, 110)),
        "sit": ((70, 100), (60, 110)),
    }[stance]
    lift, bend = (rng.uniform(*limits) for limits in ranges)
    out = rng.uniform(0, 14)
    upper = pelvis_turn @ sdf.rotation("yzx", side * out, side * out / 2, -lift)
    lower = upper @ sdf.rotation("x", bend)
    foot = sdf.rotation("y", side * rng.uniform(0, 25)) @ pelvis_turn
    hip = pelvis + pelvis_turn @ [0.095 * side, -0.04, 0]
    return _chain(hip, [0.44, 0.42, 0.2], [upper, lower, foot], [DOWN, DOWN, np.array([0, -0.25, 0.97])])


def body(rng: np.random.Generator, pose: Pose, *, hair: bool = True) -> Field:
    """Build a bare body in `pose`: trunk, limbs and head, softly joined, with a little muscle relief."""
    build = np.exp(rng.normal(0, 0.13))
    trunk = sdf.union(_trunk(rng, pose, build), 0.09)
    limbs = [sdf.union(_limb_parts(joints, "arm", build), 0.035) for joints in pose.arms]
    limbs += [sdf.union(_limb_parts(joints, "leg", build), 0.04) for joints in pose.legs]
    balls = [_ball_around(joints) for joints in (*pose.arms, *pose.legs)]
    limbs = [sdf.bound(limb, *ball) for limb, ball in zip(limbs, balls, strict=True)]
    skull = sdf.place(head(rng, hair=hair), pose.head, pose.head_turn, 0.27)
    skull = sdf.bound(skull, pose.head, 0.24)
    whole = sdf.union([sdf.union([trunk, *limbs], 0.06), skull], 0.025)
    muscle = scalar_waves(rng, 14, 45, count=20)
    return sdf.displace(whole, muscle, rng.uniform(0.002, 0.008))


def _ball_around(joints: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre and radius of a ball that holds the limb with these joints."""
    centre = joints.mean(axis=0)
    return centre, float(np.linalg.norm(joints - centre, axis=1).max()) + 0.13


def _trunk(rng: np.random.Generator, pose: Pose, build: float) -> list[Field]:
    """Return chest, belly, pelvis, buttocks, breast muscles, shoulders and neck."""
    breast = rng.uniform(0.045, 0.085)
    parts = [
        sdf.ellipsoid(pose.chest, np.array([0.155, 0.19, 0.11]) * build, pose.chest_turn),
        sdf.ellipsoid(pose.waist, np.array([0.125, 0.16, 0.095]) * build, pose.chest_turn),
        sdf.ellipsoid(pose.pelvis, np.array([0.16, 0.12, 0.115]) * build, pose.pelvis_turn),
        sdf.cone(pose.neck, pose.head, 0.062 * build, 0.055),
    ]
    for side, arm in zip((1, -1), pose.arms, strict=True):
        parts.append(sdf.ball(pose.pelvis + pose.pelvis_turn @ [0.075 * side, -0.05, -0.07], 0.09 * build))
        parts.append(sdf.ball(pose.chest + pose.chest_turn @ [0.075 * side, 0.04, 0.07], breast * build))
        parts.append(sdf.cone(pose.neck, arm[0], 0.055 * build, 0.075 * build))
    return parts


def _limb_parts(joints: np.ndarray, kind: str, build: float) -> list[Field]:
    """Return the tapering segments of an arm or leg with the swell of the calf or forearm, and hand or foot."""
    radii = {"arm": (0.068, 0.047, 0.05, 0.03), "leg": (0.1, 0.065, 0.066, 0.036)}[kind]
    top, hinge, swell, end = (radius * build for radius in radii)
    belly = joints[1] + 0.3 * (joints[2] - joints[1])
    if kind == "arm":
        palm = joints[2] + 0.45 * (joints[3] - joints[2])
        tip = [sdf.cone(joints[2], palm, 0.03, 0.042), *_fingers(palm, joints)]
    else:
        heel = joints[2] - 0.22 * (joints[3] - joints[2])
        tip = [sdf.cone(heel, joints[3], 0.04, 0.028), sdf.ball(joints[2], 0.038)]
    return [
        sdf.cone(joints[0], joints[1], top, hinge),
        sdf.cone(joints[1], belly, hinge * 0.95, swell),
        sdf.cone(belly, joints[2], swell, end),
        *tip,
    ]


def _fingers(palm: np.ndarray, joints: np.ndarray) -> list[Field]:
    """Return three finger masses and a thumb, spread in the plane across the forearm."""
    way = joints[3] - palm
    across = np.cross(way, joints[1] - joints[0])
    across = across / max(np.linalg.norm(across), 1e-6)
    fingers = [sdf.cone(palm + 0.022 * s * across, joints[3] + 0.028 * s * across, 0.019, 0.013) for s in (-1, 0, 1)]
    return [*fingers, sdf.cone(palm - way * 0.3, palm + way * 0.2 + 0.065 * across, 0.018, 0.014)]
