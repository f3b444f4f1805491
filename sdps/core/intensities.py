"""Light intensities: what the numbers mean, at every door.

An array (L,), one number per image, or (L, 3), one per image and channel: how bright each light is, positive, known up
to one scale common to all of them. Photographs have no scale of their own, so only ratios mean something.

* Files and callers give any scale. `check_intensities` refuses what cannot be intensities.
* Methods that find intensities return grey ones, (L,) float32, of mean 1 (`scale_to_mean`); networks return those of
  their training, and methods that are given intensities pass on the grey ones at the scale they were given.
* Networks are given grey intensities at the mean of the range of training; the colours (`colour_balance`) are divided
  out of the images before.
* Refinement, albedo and relighting compute per channel (`per_channel`).
* The paper's error (`sdps.core.metrics.intensity_error`) divides the truth by that of the first image (`over_first`),
  channel by channel, and fits one scale to the estimate.
* `Refined.grey_intensities` weights channels by how much of them the object reflects: what it hardly reflects is not
  measured. Everywhere else grey is the plain mean of the channels (`grey`).
"""

import numpy as np

from render.shared.errors import InputError

_TINY = 1e-8


def check_intensities(count: int, intensities: np.ndarray) -> None:
    """Refuse what cannot be the intensities of `count` lights.

    Raises:
        InputError: a shape other than (L,) or (L, 3), or a value that is not a positive finite number.
    """
    if np.shape(intensities) not in ((count,), (count, 3)):
        raise InputError(f"{count} images need as many intensities, got {np.shape(intensities)}")
    if not ((np.asarray(intensities) > 0.0) & np.isfinite(intensities)).all():
        raise InputError("light intensities must be positive finite numbers")


def grey(values: np.ndarray) -> np.ndarray:
    """Return the mean of the channels of intensities (L,) or (L, 3), (L,); also of a picture (..., 3)."""
    return values.mean(axis=-1) if values.ndim > 1 else values


def per_channel(intensities: np.ndarray) -> np.ndarray:
    """Return intensities (L,) or (L, 3) as (L, 3), a view that cannot be written to."""
    return np.broadcast_to(np.reshape(intensities, (len(intensities), -1)), (len(intensities), 3))


def scale_to_mean(intensities: np.ndarray, mean: float = 1.0) -> np.ndarray:
    """Return intensities at the scale at which the mean of all numbers is `mean`; zeros stay zeros."""
    scaled = intensities / max(float(intensities.mean()), 1e-300)
    return scaled if mean == 1.0 else scaled * mean


def colour_balance(intensities: np.ndarray) -> np.ndarray | None:
    """Return the colour of every light, (L, 3) of mean 1 each; None where intensities (L,) have no colour."""
    return None if intensities.ndim == 1 else intensities / intensities.mean(axis=1, keepdims=True)


def over_first(intensities: np.ndarray) -> np.ndarray:
    """Return intensities (L,) or (L, 3) over the first light's, channel by channel, (L, 1) or (L, 3)."""
    columns = intensities[:, None] if intensities.ndim == 1 else intensities
    return columns / (columns[0] + _TINY)
