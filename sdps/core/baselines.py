"""What knowing nothing scores: the yardstick every method has to beat."""

import numpy as np

from sdps.core.estimate import Estimate


def constant_estimate(count: int, mask: np.ndarray) -> Estimate:
    """Predict a plate facing the camera under `count` equal lights at the camera.

    Args:
        count: Number of images.
        mask: (H, W) bool.
    """
    front = np.array([0.0, 0.0, 1.0], np.float32)
    return Estimate(
        normals=mask[..., None] * front,
        light_directions=np.tile(front, (count, 1)),
        intensities=np.ones(count, np.float32),
    )
