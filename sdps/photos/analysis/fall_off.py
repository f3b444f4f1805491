"""Did the lamps stand near? On a flat object that fills the frame, each picture then dims away from its lamp.

A curved object under distant lights dims as well, and slopes cannot tell the two apart, which is why a plate under near
lamps comes out as a dome. Curvatures can. With x from the frame's centre, in frame sides, and the mean over the
pictures (paint) taken off, let log I = g.x + x'Hx / 2.

- A plate under a lamp at X, Z: I ~ Z / (|X - x|^2 + Z^2)^(3/2), so g = 3 X / R^2 with R^2 = |X|^2 + Z^2, and
  H = 2/3 gg' and a term that hardly changes from picture to picture.
- A surface of curvature C under distant light: g = -C l, and H = -gg' and a term that does not change; where its
  curvature changes over the frame, one that is linear in g.

So H is fitted by k gg', what is constant and what is linear in g: k is 2/3 for plates under near lamps, -1 for domes
under distant lights. Rendered flat plates have 0.53 to 0.88, plates with relief mostly 0.6 to 1.0 with wider errors, a
crop of DiLiGenT's ball -0.96.

Legend: L pictures, h x w blocks.
"""

from dataclasses import dataclass

import cv2
import numpy as np

FEWEST = 6
"""Pictures from which on a fit is believed."""

_BLOCKS = 16  # along the longer side
_DARKEST = 0.05  # of the median block; darker ones count as so dark
_SLOPE = 0.5  # root mean square of g from which on the lamps count as near: about 4 frame sides away
_LOW, _HIGH, _SURE = 0.4, 1.2, 3.0  # bounds of k, and of k over its error
_SINE = 0.65  # of a light's angle to the camera's axis, where nothing is known


@dataclass(frozen=True)
class FallOff:
    """How pictures dim over the frame.

    Attributes:
        slope: Root mean square over the pictures of |g|, the change of log brightness over the frame's longer side.
        k: By how much the squared slope enters the curvature, see above.
        error: Standard error of `k`.
    """

    slope: float = 0.0
    k: float = 0.0
    error: float = np.inf

    @property
    def near(self) -> bool:
        """Whether the pictures dim as a flat object does under near lamps."""
        return self.slope > _SLOPE and _LOW < self.k < _HIGH and self.k > _SURE * self.error

    @property
    def distance(self) -> float:
        """Distance of the lamps, roughly, in longer sides of the frame."""
        return 3 * _SINE / max(self.slope, 1e-6)


def block_means(grey: np.ndarray) -> np.ndarray:
    """Return the mean brightness of (H, W) float32 in blocks, (h, w), 16 along the longer side."""
    height, width = (max(6, round(_BLOCKS * side / max(grey.shape))) for side in grey.shape)
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)


def fall_off(blocks: np.ndarray, shape: tuple[int, int]) -> FallOff:
    """Fit slopes and curvatures to `block_means` (L, h, w) of pictures of a shape (H, W)."""
    blocks = blocks[np.median(blocks, axis=(1, 2)) > 0]
    if len(blocks) < FEWEST:
        return FallOff()
    typical = np.median(blocks, axis=(1, 2), keepdims=True)
    logs = np.log(np.maximum(blocks, _DARKEST * typical)).astype(np.float64)
    logs -= logs.mean((1, 2), keepdims=True)
    logs -= logs.mean(0)
    y, x = (
        (np.arange(count) + 0.5) / count * side / max(shape) - side / max(shape) / 2
        for count, side in zip(blocks.shape[1:], shape, strict=True)
    )
    y, x = np.meshgrid(y, x, indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=-1).reshape(-1, 6)
    found = np.linalg.lstsq(terms, logs.reshape(len(logs), -1).T, rcond=None)[0].T  # (L, 6)
    slopes, curvatures = found[:, 1:3], found[:, 3:]
    k, error = _factor(slopes, curvatures)
    return FallOff(float(np.sqrt((slopes**2).sum(1).mean())), k, error)


def _factor(slopes: np.ndarray, curvatures: np.ndarray) -> tuple[float, float]:
    """Fit k of curvatures (L, 3) = k gg' + constant + linear in the slopes g (L, 2), and its standard error."""
    squares = np.stack([slopes[:, 0] ** 2, slopes[:, 0] * slopes[:, 1], slopes[:, 1] ** 2], axis=-1)
    others = np.concatenate([np.ones((len(slopes), 1)), slopes], axis=1)
    rest = np.eye(len(slopes)) - others @ np.linalg.pinv(others)
    squares, curvatures = rest @ squares, rest @ curvatures
    weights = np.array([1.0, 2.0, 1.0])  # xy stands in the matrix twice
    power = float((weights * squares**2).sum())
    if power < 1e-12:
        return 0.0, float("inf")
    k = float((weights * squares * curvatures).sum()) / power
    freedom = 3 * (len(slopes) - others.shape[1]) - 1
    variance = float((weights * (curvatures - k * squares) ** 2).sum()) / freedom
    return k, float(np.sqrt(variance / power))
