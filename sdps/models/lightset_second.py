"""A second look at the lights: what the images show beside what the first lights and normals let expect.

GCNet (Chen et al., ECCV 2020) gives its second lighting network the normals and the shading of a first pass. Here the
network of the first pass looks again. It sees beside every image the shading that the first lights and normals would
give, treated as the image is, and is told the first lights.

Legend: B scenes, Q images of a scene, S = 64 pixels a side.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from sdps.models.base import Lights
from sdps.models.lightset import SIDE, LightSetNet, SetPrediction, described, without_albedo

_TOLD = 5
_DOUBTFUL = 10.0
"""Degrees to expect of a first light that count as 1."""


class LightSetSecond(LightSetNet):
    """`LightSetNet` with six more channels, and a mean of its own answer and the first lights that it weighs itself."""

    further = 6
    vectors = 2
    """Channels of the context, three by three, that turn with the scene."""

    def __init__(self, *, width: int = 256, **options: Any) -> None:
        super().__init__(width=width, **options)
        self.told = nn.Linear(_TOLD, width)
        self.weigh = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2))
        for parameter in (*self.told.parameters(), *self.weigh[-1].parameters()):
            nn.init.zeros_(parameter)

    @staticmethod
    def context(normals: Tensor, mask: Tensor, lights: Lights) -> Tensor:
        """Return normals, and directions, logarithms and expected errors of lights, (B, Q, 8, 32, 32).

        Args:
            normals: (B, 3, 32, 32).
            mask: (B, 1, 32, 32).
            lights: The first ones.
        """
        normals = normals * mask
        doubt = lights.doubted().expected
        assert doubt is not None
        told = torch.cat(
            [lights.directions, lights.intensities.log()[..., None], doubt[..., None] / _DOUBTFUL], dim=-1
        )[..., None, None].expand(-1, -1, -1, *mask.shape[-2:])
        every = normals[:, None].expand(-1, lights.directions.shape[1], -1, -1, -1)
        return torch.cat([every, told], dim=2)

    def encode(self, images: Tensor, mask: Tensor, context: Tensor | None = None) -> Tensor:
        """Return radiance, mask and context, (B, Q, 12, S, S)."""
        assert context is not None
        larger = functional.interpolate(context.flatten(0, 1).float(), (SIDE, SIDE), mode="bilinear")
        return torch.cat([super().encode(images, mask), larger.unflatten(0, context.shape[:2])], dim=2)

    def predict(self, local: Tensor, shared: Tensor | None = None) -> SetPrediction:
        """Return the prediction of every image; `local` is of all images of the scenes."""
        with torch.no_grad(), torch.autocast(local.device.type, enabled=False):
            local = local.float()
            seen, likeness = described(local[:, :, :4])
            mask, context = local[:, :, 3:4], local[:, :, 4:]
            told = context[:, :, 3:, 0, 0]  # (B, Q, 5)
            normals = functional.normalize(context[:, :, :3], dim=2) * mask
            cosine = (normals * context[:, :, 3:6]).sum(dim=2, keepdim=True)
            pattern, level = without_albedo(cosine.clamp(min=0.0) * context[:, :, 6:7].exp(), mask)
            more = [normals, cosine, torch.asinh(pattern), level.log() * mask]
            seen = torch.cat([seen, *more], dim=2)
        tokens = self.read(self.levels(seen).flatten(2)) + self.told(told)
        tokens = self.attended(tokens, likeness)
        own = self.answer(tokens)
        with torch.autocast(local.device.type, enabled=False):
            share = self.weigh(tokens.float()).sigmoid()  # (B, Q, 2)
            directions = functional.normalize(torch.lerp(told[..., :3], own.directions, share[..., :1]), dim=-1)
            first = told[..., 3] - told[..., 3].mean(dim=1, keepdim=True)
            # The mean logarithm of the own ones is the usual one.
            usual = own.intensities.log().mean(dim=1, keepdim=True)
            intensities = torch.lerp(first, own.intensities.log() - usual, share[..., 1])
            intensities = (intensities - intensities.mean(dim=1, keepdim=True) + usual).exp()
        return SetPrediction(directions, intensities, own.expected)
