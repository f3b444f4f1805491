"""A normal network whose images of one pixel look at each other before they are fused.

ESSENCE-Net's ideas (Ju et al., TPAMI 2025) on NENet's frame: images divided by each pixel's maximum over the lights,
self-attention across the lights of a pixel, and shading maps n . l of every image as additional supervision. Here the
attention works at quarter size, where theirs works at half.

Legend: B scenes, Q images of a scene, H and W multiples of 4, C channels, P pixels at quarter size.
"""

from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError, unknown
from sdps.models.base import DIVISIONS, Division, KeepingNetwork, Observations
from sdps.models.blocks import Convolution, initialise, max_over_images
from sdps.models.nenet import MaxFusionNet

WIDTH = 128
"""Channels at quarter size."""
_HEADS = 4
_STEM = 4
"""Layers of the extractor up to quarter size; the attention comes after them."""
_STRIP = 2**22
"""Values that attention works on at once in inference: 16 MiB in float32."""


class LightAttention(nn.Module):
    """Self-attention across the lights of a pixel, then a small network per light; pre-norm, no position."""

    def __init__(self) -> None:
        super().__init__()
        self.before, self.between = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.project = nn.Linear(WIDTH, 3 * WIDTH)
        self.out = nn.Linear(WIDTH, WIDTH)
        self.feed = nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH))

    def forward(self, tokens: Tensor) -> Tensor:
        """Return tokens (P, Q, C) that know of each other; their order does not matter."""
        triples = self.project(self.before(tokens)).unflatten(-1, (3, _HEADS, WIDTH // _HEADS))
        query, key, value = triples.permute(2, 0, 3, 1, 4).unbind()  # each (P, heads, Q, C / heads)
        seen = functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        tokens = tokens + self.out(seen)
        return tokens + self.feed(self.between(tokens))


class NormalsAndShading(NamedTuple):
    """What `AttentionNet` predicts while it is trained."""

    normals: Tensor  # (B, 3, H, W)
    shading: tuple[Tensor, Tensor]  # (B, Q, 1, H/4, W/4) after the attention, (B, Q, 1, H/2, W/2) before the fusion


class AttentionNet(MaxFusionNet, KeepingNetwork):
    """NENet with attention across the lights of a pixel.

    Of every image its feature at quarter size is kept until all images were seen: 16 bytes per pixel of the image, a
    third more than the image itself in float32.

    Args:
        blocks: Blocks of attention; 0 for none.
        division: What a pixel's observations are divided by: `max` over lights and channels, their `norm`, or `none`.
        shading: Learn the shading maps besides; they are not used at test.

    Raises:
        InputError: an unknown division, or a negative number of blocks.
    """

    def __init__(self, *, blocks: int = 3, division: Division = "max", shading: bool = True) -> None:
        if division not in DIVISIONS:
            raise unknown("division", str(division), DIVISIONS)
        if blocks < 0:
            raise InputError(f"blocks must not be negative, got {blocks}")
        super().__init__(6, widths=(64, 128, WIDTH), deeper=(1, 0))
        self.division, self.kept_bytes = division, 40  # what is kept, once more while it is mixed
        self.mixing = nn.Sequential(*(LightAttention() for _ in range(blocks)))
        self.shades = nn.ModuleList([Convolution(WIDTH, 1, 1), Convolution(128, 1, 1)] if shading else [])
        initialise(self)

    def tokens(self, seen: Observations) -> Tensor:
        """Return the feature of every image before the attention, (B, Q, C, H/4, W/4)."""
        return self._applied(self.extractor[:_STEM], self.inputs(seen))

    def mix(self, tokens: Tensor) -> Tensor:
        """Return the tokens (B, Q, C, h, w) after the attention."""
        scenes, _, _, height, width = tokens.shape
        rows = self.mixing(tokens.permute(0, 3, 4, 1, 2).flatten(0, 2))  # (B h w, Q, C)
        images = rows.unflatten(0, (scenes, height, width)).permute(0, 3, 1, 2, 4)  # (B, Q, h, w, C)
        return images.contiguous().permute(0, 1, 4, 2, 3)  # channels last

    def local(self, seen: Observations) -> Tensor:
        """Return the feature of every image, which knows of the others, (B, Q, F, H/2, W/2)."""
        return self._applied(self.extractor[_STEM:], self.mix(self.tokens(seen)))

    def with_shading(self, seen: Observations) -> NormalsAndShading:
        """Return normals and the shading n . l of every image, once early and once late."""
        mixed = self.mix(self.tokens(seen))
        local = self._applied(self.extractor[_STEM:], mixed)
        first, second = (self._applied(head, part) for head, part in zip(self.shades, (mixed, local), strict=True))
        return NormalsAndShading(self.regress(max_over_images(local)), (first, second))

    def kept(self, seen: Observations) -> Tensor:
        """Return the tokens of some of a scene's images, in 16 bits, for `fused`."""
        tokens = self.tokens(seen)
        return tokens.half() if tokens.dtype == torch.float32 else tokens

    def fused(self, parts: list[Tensor]) -> Tensor:
        """Return the fused feature (B, F, H/2, W/2) of all of a scene's tokens, without gradients.

        Args:
            parts: What `kept` gave, (B, q, C, h, w) each; overwritten.
        """
        lights, (width, height, columns) = sum(part.shape[1] for part in parts), parts[0].shape[2:]
        rows = max(1, _STRIP // (lights * width * columns)) if self.mixing else height
        for first in range(0, height if self.mixing else 0, rows):
            strips = [part[..., first : first + rows, :] for part in parts]
            mixed = self.mix(_working(torch.cat(strips, dim=1)))
            for strip, found in zip(strips, mixed.split([part.shape[1] for part in parts], dim=1), strict=True):
                strip.copy_(found)
        feature: Tensor | None = None
        for part in parts:
            own = max_over_images(self._applied(self.extractor[_STEM:], _working(part)))
            feature = own if feature is None else torch.maximum(feature, own)
        return cast(Tensor, feature)

    @staticmethod
    def _applied(layers: nn.Module, images: Tensor) -> Tensor:
        """Apply layers to each of (B, Q, ...) images."""
        return layers(images.flatten(0, 1)).unflatten(0, images.shape[:2])


def _working(tokens: Tensor) -> Tensor:
    """Return tokens in the precision that layers work in: float16 is for keeping them only."""
    return tokens.float() if tokens.dtype == torch.float16 else tokens
