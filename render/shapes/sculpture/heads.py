"""Human heads with face, hair and beard, as signed distance fields."""

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.sdf import Field


def head(rng: np.random.Generator, *, hair: bool = True) -> Field:
    """Build a head 1 high about its centre, facing +z: skull, face and, unless bald or hooded, hair or beard.

    Args:
        rng: Source of the proportions.
        hair: Whether to add hair and perhaps a beard.
    """
    jaw, cheek = rng.uniform(0.2, 0.27), rng.uniform(0.0, 0.05)
    parts = [
        sdf.ellipsoid([0, 0.13, -0.06], [0.36, 0.38, 0.43]),
        sdf.ellipsoid([0, -0.14, 0.07], [0.27 + cheek, 0.35, 0.31]),
        sdf.ball([0, -0.36, 0.22], jaw * 0.55),
    ]
    skull = sdf.union(parts, 0.18)
    for side in (1, -1):
        skull = sdf.subtraction(skull, sdf.ellipsoid([0.15 * side, 0.03, 0.42], [0.095, 0.06, 0.1]), 0.07)
    length, width = rng.uniform(0.09, 0.17), rng.uniform(0.035, 0.06)
    nose = [
        sdf.cone([0, 0.08, 0.36], [0, -0.1, 0.36 + length], width * 0.7, width),
        sdf.cone([-0.05, -0.12, 0.38], [0.05, -0.12, 0.38], 0.035, 0.035),
    ]
    eyes = [sdf.ball([0.145 * side, 0.025, 0.27], 0.075) for side in (1, -1)]
    brows = [sdf.cone([0.05 * side, 0.1, 0.37], [0.24 * side, 0.1, 0.27], 0.035, 0.03) for side in (1, -1)]
    lips = [sdf.ellipsoid([0, height, 0.365], [0.1, 0.028, 0.05]) for height in (-0.215, -0.275)]
    ears = [sdf.torus([0.35 * side, 0, -0.03], 0.075, 0.03, sdf.rotation("zy", 90, 15 * side)) for side in (1, -1)]
    features = [sdf.union(eyes), sdf.union(brows, 0.03), sdf.union(nose, 0.04), sdf.union(lips, 0.01), sdf.union(ears)]
    face = sdf.union([skull, *features], 0.035)
    # No two faces alike: bend the proportions, which also breaks the mirror symmetry.
    face = sdf.warp(face, vector_waves(rng, 1.5, 4, count=8), rng.uniform(0.0, 0.04))
    return _add_hair(rng, face) if hair else face


def _add_hair(rng: np.random.Generator, face: Field) -> Field:
    """Add a cap of hair with strands or curls, perhaps a bun, and perhaps a beard."""
    strand = np.array([rng.normal(0, 0.3), -1, rng.normal(0, 0.5)])
    waves = scalar_waves(rng, 14, 26, count=16, slope=0)
    if rng.random() < 0.65:
        waves = waves.stretch(strand / np.linalg.norm(strand), rng.uniform(3, 6))
    relief = sdf.furrows(waves, 0.25)
    swirl, strength = vector_waves(rng, 3, 7, count=8), rng.uniform(0.02, 0.1)
    style = rng.random()
    cap = sdf.ellipsoid([0, 0.16, -0.1], [0.42, 0.41, 0.46])
    cap = sdf.subtraction(cap, sdf.ellipsoid([0, -0.15, 0.42], [0.33, 0.42, 0.3]), 0.05)
    masses = [cap]
    if style < 0.35:  # long at the nape
        masses.append(sdf.cone([0, 0, -0.25], [rng.normal(0, 0.08), -0.6, -0.2], 0.33, 0.22))
    elif style < 0.6:  # a bun
        masses.append(sdf.ball([0, rng.uniform(0, 0.4), -0.5], rng.uniform(0.13, 0.2)))
    if rng.random() < 0.35:
        size = rng.uniform(0.15, 0.24)
        masses.append(sdf.cone([0, -0.33, 0.18], [0, -0.42 - size, 0.24], 0.19, size * 0.5))
    mane = sdf.warp(sdf.union(masses, 0.1), swirl, strength * 0.3)
    mane = sdf.displace(mane, sdf.warp(relief, swirl, strength), rng.uniform(0.015, 0.04))
    return sdf.union([face, mane], 0.015)
