"""Recipes around the human figure: single statues, groups, busts and reliefs, as signed distance fields."""

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture import drapery
from render.shapes.sculpture.bodies import Pose, body, draw_pose, turn
from render.shapes.sculpture.heads import head


def statue(rng: np.random.Generator) -> Field:
    """Build one bare, half-clothed or veiled figure on a plinth, or its torso alone."""
    pose = draw_pose(rng)
    figure = dress(rng, pose)
    if rng.random() < 0.3:
        return _fragment(rng, figure, pose)
    return sdf.union([figure, plinth(rng, pose)], 0.02)


def _fragment(rng: np.random.Generator, figure: Field, pose: Pose) -> Field:
    """Break limbs, and at times the head, off a figure: what is left is broad and fills the frame."""
    cuts = [sdf.halfspace(_tilt([0, -1, 0], rng), rng.uniform(0.12, 0.5))]
    if rng.random() < 0.5:
        cuts.append(sdf.halfspace(_tilt([0, 1, 0], rng), pose.neck[1] + 0.03))
    for side, arm in zip((1, -1), pose.arms, strict=True):
        if rng.random() < 0.8:
            cuts.append(sdf.halfspace(_tilt([side, 0, 0], rng), side * arm[0][0] + rng.uniform(0.03, 0.15)))
    broken = sdf.displace(sdf.intersection(cuts), scalar_waves(rng, 6, 40, count=20), 0.012)
    return sdf.intersection([figure, broken], 0.012)


def _tilt(way: list[float], rng: np.random.Generator) -> np.ndarray:
    """Return the unit vector `way` turned a little at random."""
    return turn(rng, 12) @ np.array(way, dtype=float)


def group(rng: np.random.Generator) -> Field:
    """Build two figures grown together, embracing, wrestling or one across the other, on rough ground."""
    figures, low = [], 0.0
    for side in (-1, 1):
        pose = draw_pose(rng)
        lean = sdf.rotation("yzx", side * rng.uniform(10, 170), rng.normal(0, 25), rng.normal(0, 20))
        place = np.array([side * rng.uniform(0.08, 0.2), rng.normal(0, 0.12), rng.normal(0, 0.08)])
        figures.append(sdf.place(dress(rng, pose), place, lean, rng.uniform(0.8, 1.0)))
        low = min(low, *(float((place + joints @ lean.T)[:, 1].min()) for joints in pose.legs))
    ground = sdf.ellipsoid([0, low, 0], [0.55, rng.uniform(0.15, 0.45), 0.45])
    ground = sdf.intersection([ground, sdf.halfspace([0, -1, 0], 0.1 - low)], 0.03)
    ground = sdf.displace(ground, scalar_waves(rng, 5, 30, slope=rng.uniform(0.3, 1.2)), rng.uniform(0.01, 0.04))
    return sdf.union([*figures, ground], 0.03)


def dress(rng: np.random.Generator, pose: Pose) -> Field:
    """Build the body in `pose` with a random choice of garments."""
    hooded = rng.random() < 0.2
    parts = [body(rng, pose, hair=not hooded)]
    style = rng.random()
    if style < 0.65:
        parts.append(drapery.skirt(rng, pose))
    if 0.25 < style < 0.8:
        parts.append(drapery.tunic(rng, pose))
    if hooded or rng.random() < 0.35:
        parts.append(drapery.mantle(rng, pose, hooded=hooded))
    return sdf.union(parts, 0.02)


def plinth(rng: np.random.Generator, pose: Pose) -> Field:
    """Build what the figure stands, kneels or sits on: a slab, a drum or a rock up to the pelvis."""
    feet = np.concatenate([joints[1:] for joints in pose.legs])
    low, middle = float(feet[:, 1].min()) - 0.02, feet.mean(axis=0)
    seated = feet[:, 1].max() > -0.2
    if seated or rng.random() < 0.3:
        top = -0.16 if seated else low + 0.1
        centre = [0.6 * middle[0], (top + low) / 2, 0.3 * middle[2] - 0.12]
        rock = sdf.box(centre, [0.3, (top - low) / 2 + 0.05, 0.26], 0.08)
        return sdf.displace(sdf.warp(rock, vector_waves(rng, 3, 8), 0.05), scalar_waves(rng, 8, 40), 0.012)
    size = rng.uniform(0.3, 0.42)
    if rng.random() < 0.5:
        return sdf.box([middle[0], low - 0.08, middle[2]], [size, 0.09, size], rng.uniform(0.005, 0.03))
    return sdf.cylinder([middle[0], low - 0.08, middle[2]], size, 0.09, rng.uniform(0.005, 0.03))


def bust(rng: np.random.Generator) -> Field:
    """Build a head with neck and draped or bare shoulders, cut off below, often on a socle."""
    head_turn = turn(rng, 16)
    hooded = rng.random() < 0.15
    skull = sdf.place(head(rng, hair=not hooded), [0, 0.37, 0], head_turn, rng.uniform(0.9, 1.05))
    neck = sdf.cone([0, -0.35, -0.06], [0, 0.2, 0], 0.21, 0.18)
    chest = [
        sdf.cone([-0.42, -0.5, -0.08], [0.42, -0.5, -0.08], 0.17, 0.17),
        sdf.ellipsoid([0, -0.72, 0], [0.46, 0.4, 0.27]),
    ]
    torso = sdf.union([neck, sdf.union(chest, 0.15)], 0.12)
    parts = [torso]
    if rng.random() < 0.7 or hooded:
        cloth = sdf.union([sdf.place(part, [0, 0, 0], None, 1.06) for part in chest], 0.15)
        if hooded:
            hood = sdf.ellipsoid([0, 0.42, -0.08], [0.46, 0.58, 0.5], head_turn)
            cloth = sdf.union([cloth, hood, sdf.cone([0, 0.2, -0.12], [0, -0.4, -0.08], 0.33, 0.36)], 0.15)
        cloth = drapery.pleat(rng, cloth, top=-0.2, bottom=-1.0)
        if hooded:
            face = 0.42 * head_turn[:, 2] + np.array([0, 0.34, 0])
            cloth = sdf.subtraction(cloth, sdf.ellipsoid(face, [0.27, 0.42, 0.36], head_turn), 0.05)
        else:
            neckline = sdf.ellipsoid([rng.normal(0, 0.1), -0.33, 0.15], [0.28, rng.uniform(0.2, 0.4), 0.3])
            cloth = sdf.subtraction(cloth, neckline, 0.04)
        parts.append(cloth)
    cut = rng.uniform(0.7, 1.0)
    below = sdf.halfspace([0, -1, 0], cut)
    if rng.random() < 0.5:
        below = sdf.union([sdf.ellipsoid([0, -0.35, 0], [0.75, cut - 0.25, 0.8]), sdf.halfspace([0, -1, 0], 0.35)], 0.1)
    solid = sdf.union([sdf.intersection([sdf.union(parts, 0.02), below], 0.02), skull], 0.05)
    if rng.random() < 0.7:
        solid = sdf.union([solid, *_socle(rng, -cut)], 0.015)
    return solid


def _socle(rng: np.random.Generator, top: float) -> list[Field]:
    """Return the turned foot of a bust below the height `top`."""
    waist = rng.uniform(0.1, 0.18)
    return [
        sdf.cylinder([0, top - 0.02, 0], 0.24, 0.05, 0.03),
        sdf.cylinder([0, top - 0.15, 0], waist, 0.2, 0.01),
        sdf.torus([0, top - 0.2, 0], waist + 0.02, 0.03),
        sdf.box([0, top - 0.34, 0], [0.27, 0.06, 0.27], 0.015),
    ]


def relief(rng: np.random.Generator) -> Field:
    """Build a carved panel: figures flattened onto a slab, inside a raised frame."""
    depth, width = rng.uniform(0.35, 0.7), rng.uniform(0.55, 0.95)
    ground = sdf.box([0, 0, -0.14], [width, 1.0, 0.1], 0.02)
    ground = sdf.displace(ground, scalar_waves(rng, 6, 40, count=24), rng.uniform(0.002, 0.012))
    figures = []
    for offset in [0.0] if width < 0.7 else [-0.38, 0.38]:
        pose = draw_pose(rng)
        facing = sdf.rotation("y", rng.uniform(-80, 80))
        figures.append(sdf.place(dress(rng, pose), [offset, 0.05, 0], facing, 0.88))
    carved = sdf.squeeze(sdf.union(figures, 0.02), [1, 1, depth])
    solid = sdf.union([ground, sdf.intersection([carved, sdf.halfspace([0, 0, -1], 0.15)])], 0.02)
    if rng.random() < 0.6:
        opening = sdf.box([0, 0, 0], [width - 0.07, 0.93, 1], 0.02)
        frame = sdf.subtraction(sdf.box([0, 0, -0.1], [width, 1.0, 0.14], 0.02), opening, 0.02)
        solid = sdf.union([solid, frame], 0.01)
    return sdf.bend(solid, rng.normal(0, 0.04), rng.uniform(0, np.pi))
