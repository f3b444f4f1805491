"""Where a learning curve is heading: a power law that falls towards a floor (Hestness et al., arXiv 1712.00409)."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from render.shared.errors import InputError
from render.shared.seeds import generator

_FEWEST = 5
_STEEPEST = 3.0


class PowerLaw(NamedTuple):
    """value = floor + scale * step ** -exponent."""

    floor: float
    scale: float
    exponent: float

    def at(self, steps: np.ndarray | float) -> np.ndarray | float:
        """Return the value the law predicts at `steps`."""
        return self.floor + self.scale * np.asarray(steps, np.float64) ** -self.exponent


def fit_power_law(steps: np.ndarray, values: np.ndarray) -> PowerLaw:
    """Fit a falling curve; relative residuals count, outliers less than squared (soft L1).

    Args:
        steps: (N,) positive.
        values: (N,) positive.

    Raises:
        InputError: fewer than five points, or values that are not positive.
    """
    steps, values = np.asarray(steps, np.float64), np.asarray(values, np.float64)
    if len(steps) < _FEWEST or not (steps > 0).all() or not (values > 0).all():
        raise InputError(f"a power law needs at least {_FEWEST} positive points, got {len(steps)}; train longer")
    middle = np.exp(np.log(steps).mean())  # steps in units of their middle, or scale and exponent would hang together

    def residuals(law: np.ndarray) -> np.ndarray:
        return np.log((law[0] + law[1] * (steps / middle) ** -law[2]) / values)

    start = [0.5 * values.min(), 0.5 * np.median(values), 0.5]
    bounds = ([0.0, 1e-12, 1e-3], [values.min(), np.inf, _STEEPEST])
    found = least_squares(residuals, start, bounds=bounds, loss="soft_l1", f_scale=0.05).x
    return PowerLaw(float(found[0]), float(found[1] * middle ** found[2]), float(found[2]))


def predicted_range(steps: np.ndarray, values: np.ndarray, at: float, *, fits: int = 200, seed: int = 0) -> np.ndarray:
    """Return the 10th, 50th and 90th percentile of predictions at a step, over fits to points drawn with replacement.

    This is the scatter of the points only; that the law holds so far out is an assumption.

    Args:
        steps, values: As for `fit_power_law`.
        at: The step.
        fits: Number of fits.
        seed: Of the draws.
    """
    fit_power_law(steps, values)  # refuses what cannot be fitted
    rng = generator(seed, "power law")
    found = []
    for _ in range(fits):
        chosen = np.sort(rng.integers(len(steps), size=len(steps)))
        if len(np.unique(chosen)) >= _FEWEST:
            found.append(np.asarray(fit_power_law(steps[chosen], values[chosen]).at(at)))
    return np.percentile(found, (10, 50, 90))
