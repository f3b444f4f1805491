"""What a method found without lights, refined under low-order light, or kept."""

from dataclasses import dataclass, replace

import numpy as np

from sdps.core.estimate import Estimate
from sdps.core.geometry import Camera
from sdps.inference.image_source import ImageSource
from sdps.refinement.surroundings.low_order import LowOrderResult, refine_low_order


@dataclass(frozen=True, kw_only=True, eq=False)
class LowOrderEstimate(Estimate):
    """An estimate after refinement under low-order light: what that found, or its start where there is a doubt.

    Attributes:
        low_order: What refinement found, kept or not.
        start: What it began with.
    """

    low_order: LowOrderResult
    start: Estimate

    @property
    def albedo(self) -> np.ndarray | None:  # (H, W, 3)
        """Relative albedo; None where refinement was not kept."""
        return None if self.low_order.doubt else self.low_order.albedo


def refine_estimate(
    images: ImageSource, mask: np.ndarray, start: Estimate, camera: Camera, saturation: float = np.inf
) -> LowOrderEstimate:
    """Return an estimate without lights, refined.

    Args:
        images: (L, H, W, 3) linear radiance.
        mask: (H, W) bool.
        start: Its normals are refined; errors it expects say how far they may move.
        camera: What the images were taken with.
        saturation: Radiance at which a channel is clipped.

    Raises:
        InputError: as `refine_low_order`.
    """
    found = refine_low_order(images, mask, start.normals, start.expected_error, camera, saturation=saturation)
    kept = replace(start) if found.doubt else replace(start, normals=found.normals, expected_error=found.expected)
    return LowOrderEstimate(**vars(kept), low_order=found, start=start)
