"""NENet, the Normal Estimation Network: images and their lights to a normal map (PS-FCN's layers).

Legend: B scenes, Q images of a scene, H and W multiples of 4.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.models.blocks import conv, deconv, initialise

SIZE_MULTIPLE = 4


class NENet(nn.Module):
    """Regresses normals from the maximum over per-image features.

    The maximum lets any number of images in, in any order; `encode` followed by `regress` lets a caller
    keep a running maximum, so that memory does not grow with the number of images.
    """

    def __init__(self) -> None:
        super().__init__()
        self.extractor = nn.Sequential(
            conv(6, 64),
            conv(64, 128, stride=2),  # H/2 x W/2
            conv(128, 128),
            conv(128, 256, stride=2),  # H/4 x W/4
            conv(256, 256),
            deconv(256, 128),  # H/2 x W/2
            conv(128, 128),
        )
        self.regressor = nn.Sequential(
            conv(128, 128),
            conv(128, 128),
            deconv(128, 64),  # H x W
        )
        self.normal = nn.Conv2d(64, 3, 3, padding=1, bias=False)
        initialise(self)

    def encode(
        self,
        images: Tensor,  # (B, Q, 3, H, W)
        directions: Tensor,  # (B, Q, 3)
    ) -> Tensor:
        """Return the maximum (B, 128, H/2, W/2) over the features of the given images.

        The images are already divided by their light intensities.
        """
        scenes, count, _, height, width = images.shape
        assert height % SIZE_MULTIPLE == 0 and width % SIZE_MULTIPLE == 0, images.shape
        broadcast = directions[..., None, None].expand(-1, -1, -1, height, width).to(images.dtype)
        inputs = torch.cat([images, broadcast], dim=2).flatten(0, 1)  # (B Q, 6, H, W)
        return self.extractor(inputs).unflatten(0, (scenes, count)).amax(dim=1)

    def regress(self, feature: Tensor) -> Tensor:
        """Return unit normals (B, 3, H, W), float32, of the aggregated feature (B, 128, H/2, W/2)."""
        feature = self.regressor(feature).float()
        # Never under autocast: a normal rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(feature.device.type, enabled=False):
            return functional.normalize(self.normal(feature), dim=1)

    def forward(self, images: Tensor, directions: Tensor) -> Tensor:
        """Return unit normals (B, 3, H, W) of (B, Q, 3, H, W) images and their (B, Q, 3) directions."""
        return self.regress(self.encode(images, directions))
