"""A lighting network whose images see each other at every stage: what one image leaves open, the others show.

LCNet looks at every image by itself, and lets them meet once, at the end, by a maximum. Here each image is first
divided by what its pixels show on average over all images, which takes the albedo away; before every convolution the
images meet by mean and maximum (as the lights of a pixel do in `sdps.models.frames`); and at the end they attend to
each other, knowing how alike they look: images that look alike have lights that are near.

Legend: B scenes, Q images of a scene, S = 64 pixels a side, C channels.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError
from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.losses import expected_distance_loss
from sdps.models.base import LightingNetwork, Lights
from sdps.models.blocks import LOG_USUAL, SLOPE, Convolution, chord_degrees
from sdps.models.covariance import unpack

SIDE = 64
"""Pixels a side that the network sees; larger images are averaged."""
_SEEN = 6
"""Channels of an image: its radiance, its shading, how bright it is as a whole, and the mask."""
_WIDTHS = (48, 96, 128, 192)
"""Channels at 32, 16, 8 and 4 pixels a side, of a network of breadth 1."""
_FLOOR = 0.01
"""Added to what images are divided by; full scale is 1."""
_BRIGHTEST = 6.0
"""Shading that counts as no more: highlights reach hundreds of times the average."""
_USUAL_INTENSITY = 0.94
"""Geometric mean of intensities drawn evenly from 0.2 to 2. Images show only their ratios."""
_USUAL_NEARNESS = -2.0
"""Nearness that training begins with, before softplus: 0.13."""
_TOGETHER = 32
"""Images that meet in use, about: many more than in training meet another mean, maximum and attention than it had."""


class SetPrediction(NamedTuple):
    """What is predicted of every image."""

    directions: Tensor  # (B, Q, 3) float32, unit
    intensities: Tensor  # (B, Q) float32, positive, relative
    expected: Tensor  # (B, Q) float32, distance to the true direction
    nearness: Tensor  # (B, Q) float32, rho of the lamps; 0 of a network that takes them for distant
    covariance: Tensor  # (B, Q, 3, 3) float32, of light's directions; 0 of a network that takes all for lamps


class Level(nn.Module):
    """Convolutions of every image, which also see the mean and the maximum over the images; half the side remains."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.own = Convolution(inputs, outputs, 3, 2, 1)
        self.shared = Convolution(2 * inputs, outputs, 3, 2, 1, bias=False)
        self.more = Convolution(outputs, outputs, 3, 1, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (B, Q, C', h / 2, w / 2) of features (B, Q, C, h, w)."""
        pooled = torch.cat([features.mean(dim=1), features.max(dim=1).values], dim=1)
        own = self.own(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        found = functional.leaky_relu(own + self.shared(pooled)[:, None], SLOPE).flatten(0, 1)
        return (found + functional.leaky_relu(self.more(found), SLOPE)).unflatten(0, features.shape[:2])


class Attention(nn.Module):
    """The images of a scene attend to each other, the more to those that look alike as each head finds fit."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.ask = nn.Linear(width, 3 * width)
        self.answer = nn.Linear(width, width)
        self.alike = nn.Sequential(nn.Linear(2, 16), nn.LeakyReLU(SLOPE), nn.Linear(16, heads))
        self.think = nn.Sequential(nn.Linear(width, 2 * width), nn.LeakyReLU(SLOPE), nn.Linear(2 * width, width))

    def forward(self, tokens: Tensor, likeness: Tensor) -> Tensor:
        """Return tokens (B, Q, C); likeness is (B, Q, Q, 2)."""
        query, key, value = self.ask(self.before(tokens)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        bias = self.alike(likeness).permute(0, 3, 1, 2)  # (B, heads, Q, Q)
        heard = functional.scaled_dot_product_attention(query, key, value, attn_mask=bias.to(query.dtype))
        tokens = tokens + self.answer(heard.transpose(1, 2).flatten(2))
        return tokens + self.think(self.between(tokens))


class LightSetNet(LightingNetwork):
    """Regresses the light of every image, and the error to expect of it, from all images together.

    Args:
        width: Channels of an image once its map is read.
        blocks: Layers of attention across the images.
        heads: Of the attention.
        intensity_range: Intensities drawn in training.
        breadth: Factor on the channels of the convolutions, which are multiples of 16.
        nearness: Predict how near the lamps stand; the released networks before it take them for distant.
        covariance: Predict how far the light of an image is from a single lamp's.
    """

    added = ("near", "about")

    def __init__(
        self, *, width: int = 256, blocks: int = 3, heads: int = 4, intensity_range: tuple[float, float] = (0.2, 2.0),
        nearness: bool = False, breadth: float = 1.0, covariance: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        if blocks < 0 or width < 1 or heads < 1 or width % heads:
            raise InputError(f"heads must divide width, and blocks be 0 or more, got {heads}, {width} and {blocks}")
        if not breadth > 0.0:
            raise InputError(f"breadth must be above 0, got {breadth:g}")
        widths = [max(16, 16 * round(breadth * channels / 16)) for channels in _WIDTHS]
        self.classes = LightClasses(low=intensity_range[0], high=intensity_range[1])
        ends = zip((_SEEN, *widths), widths, strict=False)
        self.levels = nn.Sequential(*(Level(inputs, outputs) for inputs, outputs in ends))
        self.read = nn.Linear(widths[-1] * 16, width)
        self.blocks = nn.ModuleList(Attention(width, heads) for _ in range(blocks))
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 5))
        self.near = nn.Linear(width, 1) if nearness else None
        if self.near is not None:  # all lamps begin alike
            nn.init.zeros_(self.near.weight)
            nn.init.constant_(self.near.bias, _USUAL_NEARNESS)
        self.about = nn.Linear(width, 6) if covariance else None
        if self.about is not None:
            nn.init.zeros_(self.about.weight)
            nn.init.zeros_(self.about.bias)

    def encode(self, images: Tensor, mask: Tensor) -> Tensor:
        """Return the object's radiance and the mask, (B, Q, 4, S, S), of images of any side, 128 in use."""
        masks = mask[:, None].expand(-1, images.shape[1], -1, -1, -1)
        both = torch.cat([images * masks, masks], dim=2)
        if both.shape[-2:] == (SIDE, SIDE):
            return both  # torch would take an average of every single pixel
        return functional.adaptive_avg_pool2d(both.flatten(0, 1), SIDE).unflatten(0, images.shape[:2])

    def predict(self, local: Tensor, shared: Tensor | None = None) -> SetPrediction:
        """Return the prediction of every image; `local` is of all images of the scenes."""
        with torch.no_grad(), torch.autocast(local.device.type, enabled=False):
            seen, likeness = image_inputs(local.float())
        tokens = self.read(self.levels(seen).flatten(2))
        for block in self.blocks:
            tokens = block(tokens, likeness)
        # Never under autocast: a direction rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(local.device.type, enabled=False):
            read = self.out[0](tokens.float())
            values = self.out[1](read)  # (B, Q, 5)
            nearness = torch.zeros_like(values[..., 0])
            if self.near is not None:
                nearness = functional.softplus(self.near(read)[..., 0])
            covariance = values.new_zeros(*nearness.shape, 3, 3)
            if self.about is not None:
                covariance = unpack(self.about(read))
            # Towards the camera at first; lights behind the object are not to be found.
            directions = functional.normalize(values[..., :3] + values.new_tensor([0.0, 0.0, 0.5]), dim=-1)
            strengths = values[..., 3]
            intensities = _USUAL_INTENSITY * (strengths - strengths.mean(dim=1, keepdim=True)).exp()
            return SetPrediction(directions, intensities, (values[..., 4] + LOG_USUAL).exp(), nearness, covariance)

    def predict_parts(self, parts: list[Tensor], seed: int) -> SetPrediction:
        """Return what groups of images say; all images together give the intensities of a group their scale."""
        local = torch.cat(parts, dim=1)
        together = self.predict(local)
        groups = local.shape[1] // _TOGETHER
        if groups < 2:
            return together
        found = SetPrediction(*(torch.empty_like(part) for part in together))
        order = torch.randperm(local.shape[1], generator=torch.Generator().manual_seed(seed)).to(local.device)
        for part in order.tensor_split(groups):
            some = self.predict(local[:, part])
            scale = (together.intensities[:, part] / some.intensities).log().mean(dim=1, keepdim=True).exp()
            found.directions[:, part], found.expected[:, part] = some.directions, some.expected
            found.intensities[:, part], found.nearness[:, part] = some.intensities * scale, some.nearness
            found.covariance[:, part] = some.covariance
        return found

    def loss(self, prediction: SetPrediction, truth: Lights) -> dict[str, Tensor]:
        """Return the chord of the directions, and the errors of intensities, expected error and nearness."""
        directions, intensities = truth.directions, truth.intensities
        # The tiny constant keeps the gradient of a length finite where the estimate is perfect.
        chord = ((prediction.directions - directions).square().sum(-1) + 1e-6).sqrt()  # (B, Q)
        off = (intensities / prediction.intensities).log()
        relative = (off - off.mean(dim=1, keepdim=True)).abs().mean()
        likely = expected_distance_loss(prediction.expected, chord.detach()).mean()
        total = chord.mean() + 0.5 * relative + 0.02 * likely
        terms = {"chord": chord.mean(), "relative": relative, "expected": likely}
        if self.near is not None and truth.nearness is not None:
            terms["nearness"] = (prediction.nearness - truth.nearness).abs().mean()
            total = total + terms["nearness"]
        if self.about is not None and truth.covariance is not None:
            off = (prediction.covariance - truth.covariance).square().sum(dim=(-2, -1))
            terms["covariance"] = (off + 1e-6).sqrt().mean()
            total = total + terms["covariance"]
        return {"total": total, **terms}

    def read_lights(self, prediction: SetPrediction, read_out: ReadOut = "centre") -> Lights:
        """Return the regressed lights; there are no classes to read out."""
        errors = chord_degrees(prediction.expected)
        nearness = None if self.near is None else prediction.nearness
        covariance = None if self.about is None else prediction.covariance
        found = Lights(prediction.directions, prediction.intensities, expected_error=errors)
        return found._replace(nearness=nearness, covariance=covariance)


def image_inputs(local: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the network sees of each image, (B, Q, 6, S, S), and how alike images look, (B, Q, Q, 2).

    Args:
        local: (B, Q, 4, S, S), the object's radiance and the mask.
    """
    radiance, mask = local[:, :, :3], local[:, :, 3:]
    grey = radiance.mean(dim=2, keepdim=True)
    average = grey.mean(dim=1, keepdim=True).clamp(min=0.0)  # less than nothing where a camera's black level is off
    shading = (mask * grey / (average + _FLOOR)).clamp(-1.0, _BRIGHTEST)  # (B, Q, 1, S, S), without albedo
    inside = mask.sum(dim=(2, 3, 4), keepdim=True).clamp(min=1.0)
    level = (shading.sum(dim=(2, 3, 4), keepdim=True) / inside).clamp(min=0.0) + 0.05  # (B, Q, 1, 1, 1)
    pattern = shading / level
    seen = torch.cat([radiance.clamp(min=0.0).sqrt(), torch.asinh(pattern), level.log() * mask, mask], dim=2)
    flat = pattern.flatten(2)  # (B, Q, S S)
    about = (pattern - mask).flatten(2)
    likeness = torch.stack([_cosines(flat), _cosines(about)], dim=-1)
    return seen, likeness


def _cosines(vectors: Tensor) -> Tensor:
    """Return the cosines (B, Q, Q) between vectors (B, Q, N)."""
    unit = functional.normalize(vectors, dim=-1)
    return unit @ unit.transpose(1, 2)
