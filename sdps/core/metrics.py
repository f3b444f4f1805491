"""The paper's three errors (sec. 5, "Evaluation metrics") and the maps behind them, in numpy."""

import numpy as np

from render.shared.errors import InputError
from sdps.core.estimate import Estimate, Score
from sdps.core.intensities import over_first

_TINY = 1e-8
_PART = 2**20  # vectors worked on at once


def angle_degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angle in degrees, (...) float64, between vectors (..., 3) of any length.

    A zero vector makes 90 degrees with everything.
    """
    if np.size(first) > 3 * _PART and np.ndim(first) == 2 and np.shape(first) == np.shape(second):
        parts = (slice(start, start + _PART) for start in range(0, len(first), _PART))
        return np.concatenate([angle_degrees(first[some], second[some]) for some in parts])
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    lengths = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    cosine = (first * second).sum(-1) / np.maximum(lengths, np.finfo(np.float64).tiny)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def normal_error_map(estimate: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the angular error in degrees per pixel, (H, W) float32, NaN outside `mask` (H, W) bool.

    Raises:
        InputError: shapes that differ, or an empty mask.
    """
    if estimate.shape != truth.shape or estimate.shape[:2] != mask.shape:
        raise InputError(
            f"normals {estimate.shape}, ground truth {truth.shape} and mask {mask.shape} must be of one size"
        )
    if not mask.any():
        raise InputError("the mask is empty, so there is no normal error to average")
    errors = np.full(mask.shape, np.nan, np.float32)
    errors[mask] = angle_degrees(estimate[mask], truth[mask])
    return errors


def normal_mae(estimate: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the mean angular error in degrees of normals (H, W, 3) over the mask."""
    return float(np.nanmean(normal_error_map(estimate, truth, mask), dtype=np.float64))


def direction_mae(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean angle in degrees between estimated and true light directions, both (L, 3)."""
    if np.shape(estimate) != np.shape(truth):
        raise InputError(f"{len(estimate)} estimated light directions against {len(truth)} true ones")
    return float(angle_degrees(estimate, truth).mean())


def intensity_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Return the scale-invariant relative error of light intensities (eq. 4 of the paper).

    The truth is divided, per channel, by the first image's; one scale s is fitted by least squares over
    all images and channels; the result is the mean of |e - s e~| / e.

    Args:
        estimate: (L,) estimated intensities, the same for the three channels.
        truth: (L,) or (L, 3) true intensities.
    """
    if len(estimate) != len(truth):
        raise InputError(f"{len(estimate)} estimated light intensities against {len(truth)} true ones")
    estimate, truth = np.asarray(estimate, np.float64), over_first(np.asarray(truth, np.float64))  # (L,), (L, C)
    estimate = np.broadcast_to(estimate[:, None], truth.shape)
    scale = (estimate * truth).sum() / max((estimate * estimate).sum(), _TINY)
    return float((np.abs(truth - scale * estimate) / (truth + _TINY)).mean())


def normal_scores(estimate: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> list[Score]:
    """Return the mean and median angular error and the shares of pixels under 11.25, 30 and 45 degrees."""
    errors = normal_error_map(estimate, truth, mask)[mask].astype(np.float64)
    scores = [
        Score("normal_mae", float(errors.mean()), "deg", "mean angular error of the normals over mask pixels"),
        Score("normal_median", float(np.median(errors)), "deg", "median angular error of the normals over mask pixels"),
    ]
    for limit in (11.25, 30.0, 45.0):
        share = float((errors < limit).mean())
        text = f"share of mask pixels whose normal is less than {limit:g} degrees off"
        scores.append(Score(f"normal_within_{limit:g}", share, "", text))
    return scores


def score(
    estimate: Estimate,
    mask: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    light_directions: np.ndarray | None = None,
    intensities: np.ndarray | None = None,
) -> list[Score]:
    """Score an estimate against whatever ground truth there is, in the order normals, lights, intensities."""
    scores = normal_scores(estimate.normals, normals, mask) if normals is not None else []
    if light_directions is not None:
        value = direction_mae(estimate.light_directions, light_directions)
        scores.append(Score("direction_mae", value, "deg", "mean angular error of the light directions over images"))
    if intensities is not None:
        value = intensity_error(estimate.intensities, intensities)
        text = "mean relative error of the light intensities after one least-squares scale"
        scores.append(Score("intensity_error", value, "", text))
    return scores
