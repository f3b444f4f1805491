"""A normal network that is told nothing of the light: it only has to differ between the pictures.

Each image is read once, at low resolution and beside all others (`Reader`): a few tokens say what its light is like,
and a map what surrounds each place. The unit is the pixel, as in `sdps.models.frames`: what it shows in an image, over
its own mean, listens to that image's tokens, and the images of a pixel exchange what they show (Exchange, attention).
Pooled, they give a first normal and a feature; convolutions see the fused map once for a scene. Global context that
meets pixels by attention is the idea of SDM-UniPS (Ikehata, CVPR 2023); the layers are this project's own.

Legend: B scenes, Q images of a scene, H and W the sides, N pixels of all objects, C channels, K tokens of an image.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError
from render.shared.progress import stage
from sdps.core.lighting import IRRADIANCE, harmonics
from sdps.core.losses import NormalCriterion
from sdps.models.base import Observations, Truth
from sdps.models.blocks import SLOPE, Exchange, LightAttention, attend, deconv, pool
from sdps.models.frames import CorrectedNetwork, FusedMap, StagedNormals, staged_loss
from sdps.models.lightset import Level

SIDE = 128
"""Longer side of what is read of each image, at most."""
_READ, _SEEN, _KNOWN = 9, 6, 7
"""Channels of a read image; values of a pixel in one image, and those it has in all."""
_WIDTHS = (32, 64, 96)
"""Channels of the reader at a half, a quarter and an eighth of the side."""
_DARK = 1e-3
"""Share of an image's mean below which nothing is seen."""
_BLACK = 0.02
"""Share of the brightest image's level that black images count as having: there is nothing but noise to divide by."""
_STRIP = 2**13
"""Pixels times images that are worked on at once in inference."""


class Glance(NamedTuple):
    """What is known of the images of a scene once each was read."""

    tokens: Tensor  # (B, Q, K, C), what the light is like
    surroundings: Tensor  # (B, Q, C', h, w), at half the resolution that was read


class Reader(nn.Module):
    """Reads every image of a scene at low resolution, beside the others.

    Args:
        width: C', channels of a pixel's image.
        tokens: K.
        channels: C, of a token.
        heads: Of the attention across all tokens of all images.
        layers: Of it.
    """

    def __init__(self, width: int, tokens: int, channels: int, heads: int, layers: int) -> None:
        super().__init__()
        half, quarter, eighth = _WIDTHS
        self.levels = nn.ModuleList((Level(_READ, half), Level(half, quarter), Level(quarter, eighth)))
        self.up = nn.ModuleList((deconv(eighth, quarter), deconv(2 * quarter, half)))
        self.out = nn.Conv2d(2 * half, width, 1)
        self.enter = nn.Linear(eighth, channels)
        self.asked = nn.Parameter(torch.randn(tokens, channels) * channels**-0.5)
        self.key, self.value = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.attend = nn.ModuleList(LightAttention(channels, heads) for _ in range(layers))
        self.exchange = nn.ModuleList(Exchange(channels) for _ in range(layers))

    def forward(self, seen: Tensor) -> Glance:
        """Return what images (B, Q, 9, h, w) show; h and w are multiples of 8."""
        features: list[Tensor] = []
        for level in self.levels:
            features.append(level(features[-1] if features else seen))
        half, quarter, eighth = (each.flatten(0, 1) for each in features)
        back = torch.cat([self.up[0](eighth), quarter], dim=1)
        surroundings = self.out(torch.cat([self.up[1](back), half], dim=1))
        places = self.enter(eighth.flatten(2).transpose(1, 2))  # (B Q, h w / 64, C)
        heard = attend(self.asked.to(places.dtype).expand(len(places), -1, -1), self.key(places), self.value(places))
        batch, images = seen.shape[:2]
        tokens = (self.asked + heard).unflatten(0, (batch, images)).flatten(1, 2)  # (B, Q K, C)
        for attention, exchange in zip(self.attend, self.exchange, strict=True):
            tokens = exchange(attention(tokens))
        return Glance(tokens.unflatten(1, (images, -1)), surroundings.unflatten(0, (batch, images)))


class Listen(nn.Module):
    """What a pixel shows in an image listens to the tokens of that image."""

    def __init__(self, width: int, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.before = nn.LayerNorm(width), nn.LayerNorm(channels)
        self.ask, self.tell, self.answer = (
            nn.Linear(width, width),
            nn.Linear(channels, 2 * width),
            nn.Linear(width, width),
        )
        for parameter in self.answer.parameters():
            nn.init.zeros_(parameter)

    def forward(self, pixels: Tensor, tokens: Tensor) -> Tensor:
        """Return pixels (n, Q, C') of a scene that have heard its tokens (Q, K, C)."""
        query = self.ask(self.norm(pixels)).unflatten(-1, (self.heads, -1)).permute(1, 2, 0, 3)  # (Q, heads, n, c)
        key, value = self.tell(self.before(tokens)).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return pixels + self.answer(attend(query, key, value).permute(2, 0, 1, 3).flatten(2))


class AnyLightNet(CorrectedNetwork):
    """Normals from images under any light.

    Args:
        width: C', channels of a pixel's image.
        blocks: Layers in which the images of a pixel listen to their tokens and exchange what they show.
        heads: Of all attention; divides `width` and `channels`.
        attending: Last of the blocks in which the images of a pixel also attend to each other.
        tokens: K, of an image.
        channels: C, of a token.
        layers: Of attention across all tokens of all images.
        context: Channels of `Surroundings` at an eighth of the resolution, a multiple of 4; 0 for none.
    """

    needs_lights = False
    kept_bytes = 12  # twice 6: parts are joined

    def __init__(
        self, *, width: int = 64, blocks: int = 3, heads: int = 4, attending: int = 1, tokens: int = 6,
        channels: int = 128, layers: int = 2, context: int = 160,
    ) -> None:  # fmt: skip
        super().__init__()
        if min(width, blocks, heads, tokens, channels) < 1 or layers < 0:
            raise InputError("width, blocks, heads, tokens and channels must be at least 1, and layers at least 0")
        if width % heads or channels % heads or not 0 <= attending <= blocks:
            raise InputError(f"heads must divide width and channels, and attending be 0 to blocks, got {heads}, "
                             f"{width}, {channels} and {attending}")  # fmt: skip
        self.read = Reader(width, tokens, channels, heads, layers)
        self.seen, self.known = nn.Linear(_SEEN, width), nn.Linear(_KNOWN, width)
        self.listen = nn.ModuleList(Listen(width, channels, heads) for _ in range(blocks))
        self.exchange = nn.ModuleList(Exchange(width) for _ in range(blocks))
        self.attend = nn.ModuleList(LightAttention(width, heads) for _ in range(attending))
        self.fuse = nn.Sequential(
            nn.Linear(2 * width + _KNOWN, 128), nn.LeakyReLU(SLOPE), nn.Linear(128, 128), nn.LeakyReLU(SLOPE)
        )
        self.light, self.shade = nn.Linear(channels, 9), nn.Linear(width, 1)
        self._build_map(context)
        self.size_multiple = 8

    def loss(self, seen: Observations, truth: Truth, criterion: NormalCriterion) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the losses of the normals, of the expected error, and of each image's light and shading."""
        fused, glance = self._encode(seen)
        normals, expected = self.correct(fused)
        loss, terms = staged_loss(StagedNormals(fused.face(fused.normals), normals, expected), truth, criterion)
        assert truth.light is not None
        with torch.autocast(normals.device.type, enabled=False):
            found = self.light(glance.tokens.float().mean(dim=2))
            terms["lighting_loss"] = (found - truth.light).abs().mean()
            shading = self.shade(glance.surroundings.float().permute(0, 1, 3, 4, 2))[..., 0]  # (B, Q, h, w)
            terms["shading_loss"] = shading_loss(shading, truth)
        loss = loss + criterion.lighting_weight * terms["lighting_loss"]
        return loss + criterion.shading_weight * terms["shading_loss"], terms

    def inference_seconds(self, images: int, pixels: float, box: float, views: int) -> float:
        """Return about how long inference takes: every view is read again from the start."""
        return views * (3.0e-6 * images * pixels + 2.0e-6 * box)

    def encode(self, seen: Observations) -> FusedMap:
        """Return the fused map of all of a scene's images."""
        return self._encode(seen)[0]

    def aggregate(self, accumulated: list[Observations]) -> FusedMap:
        """Return the fused map of all of a scene's images."""
        with torch.autocast(accumulated[0].images.device.type, enabled=False):  # it refuses to join 16-bit floats
            images = torch.cat([part.images for part in accumulated], dim=1)
        return self.encode(accumulated[0]._replace(images=images))

    def _encode(self, seen: Observations) -> tuple[FusedMap, Glance]:
        """Return the fused map, and what was read of the images; without gradients a few pixels at a time."""
        assert seen.mask is not None  # the network asks for it
        inside = seen.mask[:, 0] > 0.5
        glance, levels, places = self._look(seen)
        most = 2**62 if torch.is_grad_enabled() else max(1, _STRIP // seen.images.shape[1])
        found = []
        for number in range(len(inside)):
            where = inside[number].flatten().nonzero()[:, 0]
            values = seen.images[number].flatten(2)
            for some in where.split(most):
                pixels = values[..., some].permute(2, 0, 1).float()  # (n, Q, 3)
                around = self._around(glance.surroundings[number], (inside.shape[1], inside.shape[2]), some)
                own = places[number].flatten(1)[:, some].T
                found.append(self._per_pixel(pixels, levels[number], own, around, glance.tokens[number]))
                stage("normals", len(found), max(len(found), -(-len(where) // most)))
        all_found = torch.cat(found) if found else levels.new_zeros(0, self.offset.out_features + 32)
        return self.to_map(all_found, inside, seen.placement), glance

    def _look(self, seen: Observations) -> tuple[Glance, Tensor, Tensor]:
        """Return what was read of the images, their means and brightest values (B, Q, 2), and `object_places`."""
        assert seen.mask is not None
        with torch.no_grad(), torch.autocast(seen.images.device.type, enabled=False):
            levels, places = measure(seen.images, seen.mask), object_places(seen.mask)
            small = image_inputs(seen.images, seen.mask, places, levels[..., 0])
        return self.read(small), levels, places

    def _around(self, read: Tensor, size: tuple[int, int], some: Tensor) -> Tensor:
        """Return what the maps (Q, C', h, w) of a scene's images say at pixels of images of a size, (n, Q, C')."""
        rows, columns = some // size[1], some % size[1]
        grid = torch.stack([(2 * columns + 1) / size[1] - 1, (2 * rows + 1) / size[0] - 1], dim=-1)  # (n, 2), x first
        grid = grid.to(torch.float32)[None, :, None].expand(len(read), -1, -1, -1)
        with torch.autocast(read.device.type, enabled=False):
            found = functional.grid_sample(read.float(), grid, padding_mode="border", align_corners=False)
        return found[..., 0].permute(2, 0, 1)

    def _per_pixel(self, values: Tensor, levels: Tensor, places: Tensor, around: Tensor, lights: Tensor) -> Tensor:
        """Return normals and features (n, 3 + 32) of a scene's pixels (n, Q, 3).

        Args:
            values: Radiance.
            levels: (Q, 2), the images' means and brightest values.
            places: (n, 2), where pixels lie.
            around: (n, Q, C'), what surrounds them.
            lights: (Q, K, C), the tokens.
        """
        with torch.no_grad(), torch.autocast(values.device.type, enabled=False):
            seen, known = pixel_inputs(values, levels, places)
        tokens = self.seen(seen) + self.known(known)[:, None] + around
        alone = len(self.exchange) - len(self.attend)
        for number, (listen, exchange) in enumerate(zip(self.listen, self.exchange, strict=True)):
            tokens = exchange(listen(tokens, lights))
            if number >= alone:
                tokens = self.attend[number - alone](tokens)
        feature = self.fuse(torch.cat([pool(tokens), known.to(tokens.dtype)], dim=-1))
        with torch.autocast(feature.device.type, enabled=False):
            facing = values.new_tensor([0.0, 0.0, 1.0])
            normals = functional.normalize(self.offset(feature.float()) + facing, dim=-1)
        return torch.cat([normals, self.feature(feature).float()], dim=-1)


def measure(images: Tensor, mask: Tensor) -> Tensor:
    """Return the mean and the brightest value over the object, (B, Q, 2), of images (B, Q, 3, H, W)."""
    area, found = mask.sum(dim=(1, 2, 3)).clamp(min=1.0), []
    for image in images.unbind(dim=1):  # one at a time: they may be large, and kept in 16 bits
        shown = image.float() * mask
        found.append(torch.stack([shown.mean(dim=1).sum(dim=(1, 2)) / area, shown.amax(dim=(1, 2, 3))], dim=-1))
    levels = torch.stack(found, dim=1)
    return torch.maximum(levels, (_BLACK * levels.amax(dim=1, keepdim=True)).clamp(min=1e-6))


def object_places(mask: Tensor) -> Tensor:
    """Return where pixels lie, (B, 2, H, W): x to the right and y up from the object's middle, in its larger radius."""
    height, width = mask.shape[-2:]
    x = torch.arange(width, device=mask.device, dtype=torch.float32).expand(height, width)
    y = -torch.arange(height, device=mask.device, dtype=torch.float32)[:, None].expand(height, width)
    both = torch.stack([x, y]).expand(len(mask), 2, height, width)
    inside = mask > 0.5
    low = both.masked_fill(~inside, torch.inf).amin(dim=(2, 3), keepdim=True)
    high = both.masked_fill(~inside, -torch.inf).amax(dim=(2, 3), keepdim=True)
    radius = ((high - low).amax(dim=1, keepdim=True) + 1.0) / 2
    placed = (both - (low + high) / 2) / radius
    return torch.nan_to_num(placed, 0.0, 0.0, 0.0).clamp(-2.0, 2.0)


def shading_loss(found: Tensor, truth: Truth) -> Tensor:
    """Return the mean error of shading (B, Q, h, w), the inverse hyperbolic sine of what a matte surface would show.

    Its light is of order two and reaches everything; each image's mean over the object is 1.
    """
    assert truth.light is not None
    size = (found.shape[-2], found.shape[-1])
    mask = functional.adaptive_avg_pool2d(truth.mask, size)  # (B, 1, h, w)
    normals = functional.normalize(functional.adaptive_avg_pool2d(truth.normals, size), dim=1)
    shown = harmonics(normals.permute(0, 2, 3, 1)) * truth.light.new_tensor(IRRADIANCE)  # (B, h, w, 9)
    shading = torch.einsum("bhwk,bqk->bqhw", shown, truth.light).clamp(min=0.0) * mask
    area = mask.sum(dim=(2, 3), keepdim=True).clamp(min=1e-6)  # (B, 1, 1, 1)
    level = shading.sum(dim=(2, 3), keepdim=True) / area
    errors = (found - torch.asinh(shading / (level + _DARK))).abs() * mask
    return (errors.sum(dim=(2, 3), keepdim=True) / area).mean()


def image_inputs(images: Tensor, mask: Tensor, places: Tensor, means: Tensor) -> Tensor:
    """Return what is read of each image, (B, Q, 9, h, w), sides at most `SIDE` and multiples of 8.

    The radiance over the image's mean, the shares that each image has in a place's radiance of all, the mask, and where
    places lie from the object's middle.
    """
    height, width = images.shape[-2:]
    largest = max(height, width)
    scale = min(1.0, SIDE / largest)
    size = [max(8, 8 * round(scale * side / 8)) for side in (height, width)]

    def shrink(maps: Tensor) -> Tensor:
        if [height, width] == size:
            return maps
        return functional.interpolate(maps, size, mode="area" if largest > SIDE else "nearest")

    each = [shrink(image.float() * mask) for image in images.unbind(dim=1)]  # one at a time, as in `measure`
    colours = torch.stack(each, dim=1) / means[..., None, None, None]
    around = shrink(torch.cat([mask, places * mask], dim=1))[:, None].expand(-1, images.shape[1], -1, -1, -1)
    return torch.cat([torch.asinh(2.0 * colours), shares(colours, dim=1), around], dim=2)


def shares(values: Tensor, dim: int) -> Tensor:
    """Return the inverse hyperbolic sine of values over their mean over the images of `dim`; no albedo is left."""
    mean = values.mean(dim=dim, keepdim=True).clamp(min=0.0)
    return torch.asinh(values / (mean + _DARK))


def pixel_inputs(values: Tensor, levels: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the network is given of each image of a pixel, (n, Q, 6), and of the pixel, (n, 7).

    Args:
        values: (n, Q, 3), radiance; no exposure of an image changes what is returned.
        levels: (Q, 2), the images' means and brightest values.
        places: (n, 2), where pixels lie.
    """
    relative = values / levels[:, :1]  # (n, Q, 3)
    grey = relative.mean(dim=-1)  # (n, Q)
    mean = relative.mean(dim=1)  # (n, 3)
    spread = (grey - grey.mean(dim=1, keepdim=True)).square().mean(dim=1).sqrt() / (grey.mean(dim=1).abs() + _DARK)
    full = values.amax(dim=-1) / levels[:, 1]  # 1 is as bright as anything in the image: a highlight, or clipped
    dark = torch.log(grey.clamp(min=0.0) + 0.02)
    seen = torch.cat([shares(relative, dim=1), torch.stack([torch.asinh(2.0 * grey), full, dark], dim=-1)], dim=-1)
    about = torch.stack([spread, torch.full_like(spread, len(levels) ** -0.5)], dim=-1)
    return seen, torch.cat([torch.log(mean.clamp(min=0.0) + 0.02), about, places], dim=-1)
