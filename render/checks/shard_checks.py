"""Checks of one shard by itself: values, normals, mask, depth, lights, weights.

A check is a generator `check(shard, limits)` that yields `(message, severity)` for each thing wrong: the message says
what was measured and against which limit, severity ranks the findings of one check (larger is worse). Checks assume
finite arrays, but for `values`, which checks that they are. Frame as everywhere: x right, y up, z to the camera.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from render.materials.textures.textured import is_textured
from render.records import view_geometry
from render.records.shards import HALF_LIMIT, Shard
from render.shared.config import check_fields
from render.shared.errors import InputError

Complaints = Iterator[tuple[str, float]]
SLOPE = 0.2  # |dz/dx| from which a sign says something
SMOOTH = 0.4  # least ratio of the slopes to both sides of a pixel
STEEP = 0.3  # n.z below which a pixel's slope changes too fast for differences of neighbours


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Thresholds of the checks; docs/reference/checks.md says why each is what it is.

    Attributes:
        unit_error: Largest | |v| - 1 | of normals and light directions.
        facing: z of a normal below which the surface looks away from the camera.
        away: Largest share of such normals in the mask.
        min_area, max_area: Bounds on the share of the frame the mask covers.
        saturated: Largest share of the object's values at the largest half.
        depth_agreement: Smallest share of slopes of the depth whose sign the normals confirm.
        depth_scale: Largest factor between the slopes of depth and of the normals (median), either way.
        correlation: Smallest mean rank correlation, over the lights, of intensity with max(n.l, 0).
        margin: How much better the normals must explain the shading than with axes flipped or swapped; within it either
            way a scene is unresolved.
        min_lights: Fewest lights from which shading is judged.
        black_lights: Largest share of lights that leave the object black though they face a good part of it.
        attached: Largest median radiance where n.l < -0.15, relative to the lit mean, with interreflections.
        attached_direct: The same in direct light alone.
        dim: Smallest 95th percentile of an object's radiance (a white Lambertian facing the light has 1).
        weights_error: Largest | sum of the material weights - 1 | in the mask.
    """

    unit_error: float = 1e-3
    facing: float = -0.1
    away: float = 0.01
    min_area: float = 0.01
    max_area: float = 0.999
    saturated: float = 1e-3
    depth_agreement: float = 0.8
    depth_scale: float = 1.3
    correlation: float = 0.3
    margin: float = 0.1
    min_lights: int = 4
    black_lights: float = 0.0
    attached: float = 0.2
    attached_direct: float = 0.02
    dim: float = 1e-5
    weights_error: float = 1e-2

    def __post_init__(self) -> None:
        if not 0 <= self.min_area < self.max_area <= 1:
            raise InputError(f"min_area and max_area must rise within [0, 1], got {self.min_area}, {self.max_area}")
        for name in ("away", "depth_agreement", "black_lights", "saturated"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is a share and must be in [0, 1], got {getattr(self, name)}")
        if self.depth_scale < 1:
            raise InputError(f"depth_scale is a factor and must be at least 1, got {self.depth_scale}")
        check_fields(
            self, "not negative", "unit_error", "margin", "attached", "attached_direct", "dim", "weights_error"
        )


def values(shard: Shard, limits: Limits) -> Complaints:
    """Every array finite, radiance not negative and below the largest half but for a few pixels.

    `render.records.shards.to_half` saturates at the largest half, so a share of values there means lost highlights.
    """
    for name in ("images", "normals", "depth", "coverage", "light_directions"):
        bad = int((~np.isfinite(getattr(shard, name))).sum())
        if bad:
            yield f"{name} has {bad} infinite or NaN values", float(bad)
    negative = int((shard.images < 0).sum())
    if negative:
        yield f"{negative} radiance values are negative", float(negative)
    share = float((shard.images[:, shard.mask] >= HALF_LIMIT).mean()) if shard.mask.any() else 0.0
    if share > limits.saturated:
        yield f"{share:.2%} of the object's radiance is at the half limit of {HALF_LIMIT:g}", share


def unit_normals(shard: Shard, limits: Limits) -> Complaints:
    """Normals have length 1 in the mask and are zero outside."""
    lengths = np.linalg.norm(shard.normals.astype(np.float64), axis=-1)
    error = float(np.abs(lengths[shard.mask] - 1).max(initial=0.0))
    if error > limits.unit_error:
        yield f"a normal in the mask has length off by {error:.3g} (limit {limits.unit_error:g})", error
    outside = int((lengths[~shard.mask] != 0).sum())
    if outside:
        yield f"{outside} pixels outside the mask have a normal", float(outside)


def facing_normals(shard: Shard, limits: Limits) -> Complaints:
    """Visible normals face the camera (n.v > 0), but for interpolated ones at the rim: some pixels, a little behind."""
    towards = view_geometry.view_directions(shard.mask.shape, shard.camera_distance)[shard.mask]
    share = float(((shard.normals[shard.mask] * towards).sum(-1) < limits.facing).mean())
    if share > limits.away:
        yield f"{share:.1%} of the normals face away from the camera (limit {limits.away:.0%})", share


def mask_area(shard: Shard, limits: Limits) -> Complaints:
    """The mask covers a share of the frame within bounds, and is where at least half the samples hit.

    A composition may fill the frame: its ground goes on where an object would end.
    """
    area = float(shard.mask.mean())
    most = limits.max_area if shard.objects is None else 1.0
    if not limits.min_area <= area <= most:
        severity = max(limits.min_area - area, area - most)
        yield (
            f"the mask covers {area:.1%} of the frame (limits {limits.min_area:.0%} to {most:.0%})",
            severity,
        )
    if shard.coverage.min() < 0 or shard.coverage.max() > 1:
        yield f"coverage leaves [0, 1] ({shard.coverage.min():g} to {shard.coverage.max():g})", 1.0
    different = float((shard.mask != (shard.coverage >= 0.5)).mean())
    if different:
        yield f"mask and coverage disagree on {different:.1%} of the pixels", different


def has_depth(shard: Shard) -> bool:
    """Return whether a shard holds depth; imported data sets without it have zeros."""
    return bool(shard.depth[shard.mask].any())


def depth_slopes(shard: Shard) -> tuple[np.ndarray, np.ndarray]:  # (N,), (N,)
    """Pair the slopes of the depth with those the normals predict, along x and y together.

    A surface z(x, y) has the normal (-dz/dx, -dz/dy, 1) up to scale, so the prediction is -n.x/n.z and -n.y/n.z. Under
    perspective (`render.records.view_geometry`), x and y shrink by s = 1 - z/D, and it is -n.x s / (n.z - (x n.x +
    y n.y)/D) with the image point (x, y).
    Neighbours are 2/W half image widths apart. Left out are pixels next to the silhouette or nearly edge-on, and steps:
    where one part hides another, the slopes to both sides differ widely.

    Returns:
        Measured and predicted slopes where the prediction exceeds `SLOPE`.
    """
    step = 2.0 / shard.mask.shape[1]
    along, shrunk = shard.normals[..., 2].astype(np.float64), np.ones(shard.mask.shape)
    if shard.camera_distance is not None:
        image = view_geometry.image_points(shard.mask.shape)
        along = along - (image * shard.normals[..., :2]).sum(-1) / shard.camera_distance
        shrunk = 1 - shard.depth / shard.camera_distance
    inside = shard.mask & (along > STEEP)
    z = np.where(shard.mask, shard.depth, np.nan).astype(np.float64)
    measured, predicted = [], []
    for axis, sign, component in ((1, 1.0, 0), (0, -1.0, 1)):  # rows run down, y runs up
        ahead = sign * np.diff(z, axis=axis, append=np.nan) / step
        behind = sign * np.diff(z, axis=axis, prepend=np.nan) / step
        low, high = np.minimum(abs(ahead), abs(behind)), np.maximum(abs(ahead), abs(behind))
        slope = -shard.normals[..., component] * shrunk / np.where(inside, along, 1.0)
        kept = inside & (ahead * behind > 0) & (low > SMOOTH * high) & (abs(slope) > SLOPE)
        measured.append((ahead + behind)[kept] / 2)
        predicted.append(slope[kept])
    return np.concatenate(measured), np.concatenate(predicted)


def depth(shard: Shard, limits: Limits) -> Complaints:
    """Depth is zero outside the mask, and its slopes agree in sign and size with the normals.

    Signs are counted and sizes compared by their median, so creases and occlusion steps do not matter. The relief of a
    texture is in the normals and not in the depth, whose slopes are smaller: there sizes are not compared.
    """
    outside = int((shard.depth[~shard.mask] != 0).sum())
    if outside:
        yield f"{outside} pixels outside the mask have a depth", float(outside)
    if not has_depth(shard):
        return
    measured, predicted = depth_slopes(shard)
    if len(measured) < 50:  # a plane that faces the camera says nothing
        return
    agreement = float((measured * predicted > 0).mean())
    if agreement < limits.depth_agreement:
        yield (
            f"depth slopes agree with the normals' in sign at {agreement:.0%} of the pixels "
            f"(limit {limits.depth_agreement:.0%})", 1 - agreement,
        )  # fmt: skip
        return
    if is_textured(str(shard.provenance.get("material", ""))):
        return
    factor = float(np.median(measured / predicted))
    if not 1 / limits.depth_scale <= factor <= limits.depth_scale:
        yield f"depth slopes are {factor:.2f} times the normals' (depth is in half image widths)", abs(np.log(factor))


def lights(shard: Shard, limits: Limits) -> Complaints:
    """Light directions are unit vectors above the horizon (z > 0), and positions of near lights lie along them."""
    directions = shard.light_directions.astype(np.float64)
    error = float(np.abs(np.linalg.norm(directions, axis=1) - 1).max())
    if error > limits.unit_error:
        yield f"a light direction has length off by {error:.3g} (limit {limits.unit_error:g})", error
    below = np.flatnonzero(directions[:, 2] <= 0)
    if shard.light_positions is not None:
        towards = shard.light_positions - shard.centre
        error = float(np.abs(towards / np.linalg.norm(towards, axis=1, keepdims=True) - directions).max())
        if error > limits.unit_error:
            yield f"a light's position lies off its direction by {error:.3g} (limit {limits.unit_error:g})", error
    if len(below):
        yield f"{len(below)} lights are below the horizon (the first is number {below[0]})", float(len(below))


def objects(shard: Shard, limits: Limits) -> Complaints:
    """Compositions: every pixel of the mask shows an object, and none outside does."""
    if shard.objects is None:
        return
    different = float(((shard.objects > 0) != shard.mask).mean())
    if different:
        yield f"mask and objects disagree on {different:.1%} of the pixels", different


def material_weights(shard: Shard, limits: Limits) -> Complaints:
    """Weights of spatially-varying scenes: one map per material, in [0, 1], sum 1 in the mask and 0 outside."""
    weights = shard.weights
    if weights is None:
        return
    names = shard.materials
    if len(weights) != len(names):
        yield f"{len(weights)} weight maps for {len(names)} materials", 1.0
    if not np.isfinite(weights).all():
        yield "weights have infinite or NaN values", 1.0
        return
    if weights.min() < 0 or weights.max() > 1 + limits.weights_error:
        yield f"weights leave [0, 1] ({weights.min():.3g} to {weights.max():.3g})", float(np.abs(weights).max())
    error = float(np.abs(weights.sum(axis=0)[shard.mask] - 1).max(initial=0.0))
    if error > limits.weights_error:
        yield f"weights sum to 1 only within {error:.3g} (limit {limits.weights_error:g})", error
    if weights[:, ~shard.mask].any():
        yield "weights are not zero outside the mask", 1.0
