"""NENet, the Normal Estimation Network: images and their lights to a normal map (PS-FCN's layers).

Legend: B scenes, Q images of a scene, H and W multiples of 4.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.models.base import FusionNetwork, Observations
from sdps.models.blocks import conv, deconv, initialise, max_over_images


class MaxFusionNet(FusionNetwork):
    """Extractor per image, maximum over the images, regressor: the frame NENet, PS-FCN and UPS-FCN share.

    Args:
        inputs: Input channels.
        widths: Channels of the extractor at full, half and quarter size.
        deeper: Further convolutions of the extractor at quarter size, and of the regressor at half size.
    """

    def __init__(
        self, inputs: int, *, widths: tuple[int, int, int] = (64, 128, 256), deeper: tuple[int, int] = (0, 0)
    ) -> None:
        super().__init__()
        full, half, quarter = widths
        self.extractor = nn.Sequential(
            conv(inputs, full),
            conv(full, half, stride=2),  # H/2 x W/2
            conv(half, half),
            conv(half, quarter, stride=2),  # H/4 x W/4
            conv(quarter, quarter),
            *(conv(quarter, quarter) for _ in range(deeper[0])),
            deconv(quarter, half),  # H/2 x W/2
            conv(half, half),
        )
        self.regressor = nn.Sequential(
            conv(half, half),
            conv(half, half),
            *(conv(half, half) for _ in range(deeper[1])),
            deconv(half, full),  # H x W
        )
        self.normal = nn.Conv2d(full, 3, 3, padding=1, bias=False)
        # A convolution reaches a pixel of its own size, a transposed one a pixel of what it sees.
        self.reach = 24 + 4 * deeper[0] + 2 * deeper[1]

    @staticmethod
    def inputs(seen: Observations) -> Tensor:
        """Return the input channels of every image, (B, Q, C, H, W)."""
        _, count, _, height, width = seen.images.shape
        assert height % MaxFusionNet.size_multiple == 0 and width % MaxFusionNet.size_multiple == 0, seen.images.shape
        parts = [seen.images]
        if seen.directions is not None:
            lights = seen.directions.to(seen.images.dtype)[..., None, None]
            parts.append(lights.expand(-1, -1, -1, height, width))
        if seen.mask is not None:
            parts.append(seen.mask[:, None].expand(-1, count, -1, -1, -1))
        return torch.cat(parts, dim=2) if len(parts) > 1 else seen.images

    def local(self, seen: Observations) -> Tensor:
        """Return the feature of every image, (B, Q, F, H/2, W/2)."""
        return self.extractor(self.inputs(seen).flatten(0, 1)).unflatten(0, seen.images.shape[:2])

    def encode(self, seen: Observations) -> Tensor:
        """Return the maximum (B, F, H/2, W/2) over the features of the given images."""
        return max_over_images(self.local(seen))

    def regress(self, feature: Tensor) -> Tensor:
        """Return unit normals (B, 3, H, W), float32, of the aggregated feature (B, F, H/2, W/2)."""
        feature = self.regressor(feature).float()
        # Never under autocast: a normal rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(feature.device.type, enabled=False):
            return functional.normalize(self.normal(feature), dim=1)


class NENet(MaxFusionNet):
    """Regresses normals from images divided by their intensities, and the direction of each (SDPS-Net, sec. 4.2).

    PS-FCN (Chen et al., ECCV 2018) has the same layers and differs in training only.

    Args:
        per_pixel: Divide by each pixel's norm over the lights first, as PS-FCN (Norm.) does.
    """

    def __init__(self, *, per_pixel: bool = False) -> None:
        super().__init__(6)
        self.normalised = per_pixel
        initialise(self)
