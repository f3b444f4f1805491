"""Height, slopes and curvature of the surface as TIFF files, in millimetres where the size of a pixel is known.

Let X(u, v) be the surface over columns u and rows v, n its normal, and dn = W dX. W is the shape operator, with the
sign for which a ball of radius R has H = 1 / R: what bulges to the camera is positive, a dent negative.

    I = [[X_u X_u, X_u X_v], [X_u X_v, X_v X_v]],   B = [[n_u X_u, n_u X_v], [n_v X_u, n_v X_v]],   W = I^-1 B
    H = tr(W) / 2 (half the divergence of n),   K = det(W)

(do Carmo, Differential Geometry of Curves and Surfaces, sec. 3.3). The tangents X_u and X_v follow from the normals and
the camera, n_u and n_v from the normals alone. Depth, which scales the tangents under perspective, is never derived.
"""

from pathlib import Path
from typing import Any

import numpy as np

from render.shared.files import write_json
from sdps.core.integration import STEEPEST
from sdps.inference.tiles import split_rows
from sdps.surface.exports.map_files import write_tiff
from sdps.surface.exports.saved_result import SavedResult

_LEVELS = 65534  # of heights in 16 bits; 0 is the background


def write_heights(result: SavedResult, folder: Path) -> list[Path]:
    """Write height.tif (float32, in `result.unit`, 0 outside the mask), height-16bit.tif and height.json.

    height = lowest + (value - 1) x step of 16-bit values from 1; 0 is outside.
    """
    heights, mask = result.depth * np.float32(result.unit_size), result.mask
    lowest, highest = float(heights[mask].min()), float(heights[mask].max())
    step = (highest - lowest) / (_LEVELS - 1) or 1.0
    coded = np.where(mask, np.rint((heights.astype(np.float64) - lowest) / step) + 1, 0).astype(np.uint16)
    facts = {"what": "height towards the camera", "unit": result.unit, "lowest": lowest, "highest": highest,
             "step": step, **_scale(result)}  # fmt: skip
    plain = {key: value for key, value in facts.items() if key != "step"}
    made = [
        write_tiff(folder / "height.tif", np.where(mask, heights, np.float32(0)), result.pixel_size, plain),
        write_tiff(folder / "height-16bit.tif", coded, result.pixel_size, facts | {"outside": 0, "first": 1}),
        folder / "height.json",
    ]
    write_json(made[-1], facts | {"height_of_16bit": "lowest + (value - 1) * step; 0 is outside"})
    return made


def write_gradients(result: SavedResult, folder: Path) -> list[Path]:
    """Write gradient-x.tif and gradient-y.tif (float32): dz/dx, x to the right, and dz/dy, y up; 0 outside the mask."""
    facing = np.maximum(result.normals[..., 2], STEEPEST)
    made = []
    for axis, name in enumerate("xy"):
        facts = {"what": f"dz/d{name}", "axes": "x right, y up, z to the camera", "unit": "1", **_scale(result)}
        values = -result.normals[..., axis] / facing
        made.append(write_tiff(folder / f"gradient-{name}.tif", values.astype(np.float32), result.pixel_size, facts))
    return made


def write_curvatures(result: SavedResult, folder: Path) -> list[Path]:
    """Write mean-curvature.tif and gaussian-curvature.tif (float32), 0 outside the mask."""
    made = []
    for name, values, power in zip(("mean", "gaussian"), measure_curvatures(result), (1, 2), strict=True):
        unit = f"1/{result.unit}" + ("" if power == 1 else "^2")
        facts = {"what": f"{name} curvature", "unit": unit, "sign": "positive of what bulges to the camera"}
        path = folder / f"{name}-curvature.tif"
        made.append(write_tiff(path, values, result.pixel_size, facts | _scale(result)))
    return made


def measure_curvatures(result: SavedResult) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and Gaussian curvature, (H, W) float32, in 1 / `result.unit` and its square.

    0 outside the mask, and at pixels without a neighbour in their row or column.
    """
    mean, gauss = (np.zeros(result.shape, np.float32) for _ in range(2))
    for kept in split_rows(mean.shape):
        seen = slice(max(kept.start - 1, 0), kept.stop + 1)  # with the rows beside it
        found = _measure(result, seen)
        for whole, part in zip((mean, gauss), found, strict=True):
            whole[kept] = part[kept.start - seen.start :][: len(whole[kept])]
    return mean, gauss


def _measure(result: SavedResult, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return both curvatures of some rows, of these alone."""
    normals, known = result.normals[rows].astype(np.float64), result.mask[rows]
    tangents, steps = _find_tangents(result, rows), []
    for axis in (1, 0):
        step, found = _differentiate(normals, result.mask[rows], axis)
        steps.append(step)
        known = known & found
    (uu, uv), (_, vv) = ([(a * b).sum(-1) for b in tangents] for a in tangents)  # I
    (b_uu, b_uv), (b_vu, b_vv) = ([(a * b).sum(-1) for b in tangents] for a in steps)  # B
    area = np.where(known, uu * vv - uv * uv, 1.0)
    mean = (vv * b_uu - uv * (b_uv + b_vu) + uu * b_vv) / (2.0 * area)
    gauss = (b_uu * b_vv - b_uv * b_vu) / area
    size = result.unit_size
    return np.where(known, mean / size, 0.0), np.where(known, gauss / size**2, 0.0)


def _find_tangents(result: SavedResult, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return X_u and X_v of some rows, (R, W, 3) float64, in pixels."""
    camera, normals = result.camera, result.normals[rows].astype(np.float64)
    numbers = np.arange(result.shape[0])[rows, None]
    sights = camera.look(result.shape, numbers, np.arange(result.shape[1])[None])
    facing = np.maximum((normals * sights).sum(-1), STEEPEST)
    shrunk = 1.0 - result.depth[rows] / camera.focal  # 1 of an orthographic camera
    found = []
    for axis, sign in ((0, 1.0), (1, -1.0)):  # a column to the right is +x, a row down -y
        rise = -sign * shrunk * normals[..., axis] / facing  # of z
        tangent = rise[..., None] * sights
        tangent[..., axis] += sign * shrunk
        found.append(tangent)
    return found[0], found[1]


def _differentiate(values: np.ndarray, mask: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivative of values (H, W, 3) along an axis inside a mask, one-sided at its rim, and where there
    is one.
    """
    there = np.pad(mask, [(1, 1) if side == axis else (0, 0) for side in (0, 1)])
    before, after = (np.take(there, range(start, start + mask.shape[axis]), axis) for start in (0, 2))
    padded = np.pad(values, [(1, 1) if side == axis else (0, 0) for side in (0, 1, 2)])
    last, next_ = (np.take(padded, range(start, start + mask.shape[axis]), axis) for start in (0, 2))
    low, high = np.where(before[..., None], last, values), np.where(after[..., None], next_, values)
    count = before.astype(int) + after
    return (high - low) / np.maximum(count, 1)[..., None], mask & (count > 0)


def _scale(result: SavedResult) -> dict[str, Any]:
    return {"pixel_size_mm": result.pixel_size}
