"""Checks of a shard's images against its normals and lights: handedness, attached shadows, black images.

These find what no single array shows: a flipped axis, shuffled lights, normals of another scene. They assume nothing
about the material but that more of the light arrives where n.l is larger and none where it is negative.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import rankdata

from render.checks.shard_checks import Complaints, Limits
from render.records import view_geometry
from render.records.shards import Shard

PIXELS = 600  # per scene; more do not change the mean correlation
TILT = 0.3  # |n.d| from which a pixel can tell a reflection along d
# Mistakes of the frame, each a reflection n - 2 (n.d) d of the normals; d is also the tilt that can tell it.
FLIPS = {
    "x flipped": np.array([1.0, 0.0, 0.0]),
    "y flipped": np.array([0.0, 1.0, 0.0]),
    "x and y swapped": np.array([0.5**0.5, -(0.5**0.5), 0.0]),
}
SHADED = 0.15  # |n.l| from which a pixel counts as facing the light or turned from it
FEWEST = 30  # pixels, or pairs of pixel and light, below which there is no evidence


@dataclass(frozen=True)
class Agreement:
    """How well the normals explain the shading.

    Attributes:
        correlation: Mean rank correlation of intensity with max(n.l, 0) over the lights; NaN without evidence.
        margins: Per entry of `FLIPS`, the correlation of the normals as they are minus that of the reflected ones, over
            pixels tilted that way; NaN where too few are.
    """

    correlation: float
    margins: dict[str, float]


@lru_cache(maxsize=1)  # two checks of one shard ask for it
def measure_agreement(shard: Shard) -> Agreement:
    """Rank-correlate each pixel's intensities with max(n.l, 0) over the lights (Spearman), and again with wrong axes.

    Ranks make this independent of the reflectance as long as brighter goes with larger n.l; highlights of mirror-like
    materials and cast shadows weaken it but keep its sign, since what is turned from the light is dark for all.
    """
    normals, intensity, lights = _object_pixels(shard)
    if not len(normals):
        return Agreement(float("nan"), dict.fromkeys(FLIPS, float("nan")))
    ranks = _rank_centred(intensity)
    upright = _correlation(ranks, normals, lights)
    margins = {}
    for name, direction in FLIPS.items():
        tilt = normals @ direction
        tilted = np.abs(tilt) > TILT
        if tilted.sum() < FEWEST:
            margins[name] = float("nan")
            continue
        reflected = normals[tilted] - 2 * tilt[tilted, None] * direction
        margins[name] = float(np.mean(upright[tilted] - _correlation(ranks[:, tilted], reflected, lights[:, tilted])))
    return Agreement(float(np.mean(upright)), margins)


def shading(shard: Shard, limits: Limits) -> Complaints:
    """Intensity rises with n.l, clearly more so than with the axes of the normals flipped or swapped."""
    if len(shard.images) < limits.min_lights:
        return
    agreement = measure_agreement(shard)
    worst = min(agreement.margins, key=lambda name: np.nan_to_num(agreement.margins[name]))
    margin = agreement.margins[worst]
    if margin < -limits.margin:
        yield (
            f"shading fits the normals better with {worst} (rank correlation with n.l {-margin:.2f} higher)",
            1 - margin,
        )
    elif agreement.correlation < limits.correlation:
        yield (
            f"rank correlation of intensity with n.l over the lights is {agreement.correlation:.2f} "
            f"(limit {limits.correlation:g})", 1 - agreement.correlation,
        )  # fmt: skip


def unresolved(shard: Shard, limits: Limits) -> Complaints:
    """No evidence of the handedness: too few lights, too little tilt, or both ways explain the shading alike."""
    if len(shard.images) < limits.min_lights:
        yield f"{len(shard.images)} lights are too few to judge shading (limit {limits.min_lights})", 1.0
        return
    for name, margin in measure_agreement(shard).margins.items():
        if np.isnan(margin):
            yield f"too few pixels are tilted so as to tell {name} from right", 1.0
        elif abs(margin) <= limits.margin:
            yield f"shading does not tell {name} from right (margin {margin:.2f})", 1.0


def black_images(shard: Shard, limits: Limits) -> Complaints:
    """No image is black on the object though its light faces a good part of it (n.l > 0.3 on 30 % of the mask)."""
    normals, _, lights = _object_pixels(shard)
    facing = np.mean(_cosines(lights, normals) > 0.3, axis=1) > 0.3 if len(normals) else np.zeros(len(lights), bool)
    black = ~np.any(shard.images[:, shard.mask] > 0, axis=(1, 2))
    if black.all():
        yield "every image is black on the object", 2.0
        return
    share = float(black[facing].mean()) if facing.any() else 0.0
    if share > limits.black_lights:
        first = int(np.flatnonzero(black & facing)[0])
        yield f"{share:.0%} of the lights that face the object leave it black (the first is number {first})", share


def check_attached_shadows(shard: Shard, limits: Limits) -> Complaints:
    """Pixels turned from the light (n.l < -0.15) are dark, but for interreflections.

    The median over all such pairs of pixel and light, relative to the mean of pairs with n.l > 0.15.
    """
    normals, intensity, lights = _object_pixels(shard)
    cosines = _cosines(lights, normals)
    turned, facing = intensity[cosines < -SHADED], intensity[cosines > SHADED]
    if len(turned) < FEWEST or len(facing) < FEWEST or facing.mean() <= 0:
        return
    level = float(np.median(turned) / facing.mean())
    direct = shard.provenance.get("bounces", 1) == 0
    limit = limits.attached_direct if direct else limits.attached
    if level > limit:
        yield f"pixels turned from the light have {level:.0%} of the lit radiance (limit {limit:.0%})", level


def exposure(shard: Shard, limits: Limits) -> Complaints:
    """The object is bright enough to survive half precision: the 95th percentile of its radiance is above `dim`."""
    level = float(np.percentile(shard.images[:, shard.mask].astype(np.float32), 95)) if shard.mask.any() else 0.0
    if level < limits.dim:
        yield f"95 % of the object is darker than {level:.2g} (limit {limits.dim:g})", limits.dim - level


def _object_pixels(shard: Shard) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # (P, 3), (L, P), (L, P, 3)
    """Return normals, grey intensities and light directions of up to `PIXELS` pixels, evenly spread over the mask.

    The intensities are those under irradiance pi at the pixel, which near lights have at the object's centre only.
    """
    places = np.flatnonzero(shard.mask)
    places = places[:: max(1, len(places) // PIXELS)]
    normals = shard.normals.reshape(-1, 3)[places].astype(np.float64)
    flat = shard.images.reshape(len(shard.images), -1, 3)
    intensity = flat[:, places].astype(np.float64).mean(axis=-1)
    points = view_geometry.points(shard.depth.astype(np.float64), shard.camera_distance).reshape(-1, 3)[places]
    lights, irradiance = view_geometry.incident(points, shard.light_directions, shard.light_positions, shard.centre)
    return normals, intensity / irradiance, lights


def _cosines(lights: np.ndarray, normals: np.ndarray) -> np.ndarray:  # (L, P)
    """Return n.l of lights (L, P, 3) and normals (P, 3)."""
    return np.einsum("lpc,pc->lp", lights, normals)


def _rank_centred(values: np.ndarray) -> np.ndarray:
    """Return the ranks along the first axis, ties shared, minus their mean."""
    ranks = rankdata(values, axis=0)
    return ranks - ranks.mean(axis=0)


def _correlation(ranks: np.ndarray, normals: np.ndarray, lights: np.ndarray) -> np.ndarray:  # (P,)
    """Correlate centred ranks (L, P) with those of max(n.l, 0), lights (L, P, 3); 0 where either is constant."""
    expected = _rank_centred(np.maximum(_cosines(lights, normals), 0.0))
    norm = np.sqrt((ranks**2).sum(axis=0) * (expected**2).sum(axis=0))
    return (ranks * expected).sum(axis=0) / np.where(norm > 0, norm, 1.0)
