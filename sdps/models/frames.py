"""A normal network that sees every pixel in the frame of a first normal, and context only after the lights are fused.

What a pixel of an isotropic material shows depends on the angles between its normal, the lights and the view, and on
nothing else. So each pixel's lights are turned into the frame of a first normal, found by robust least squares: z along
it, the view in the plane of x and z. There all normals are near z, whatever way the surface faces, and one pixel
teaches what others of another orientation need. Images of a pixel meet by their mean and maximum (as in Deep Sets,
Zaheer et al., NeurIPS 2017), and may attend to each other, a few times over, without convolutions; convolutions see the
fused map, once for a scene and not once for an image. The network is given the error to expect of each light: it may
trust lights that were measured, and know better than lights that were estimated badly.

Near lamps light every pixel from a direction of its own, and a perspective camera sees it along a line of its own.
Where pixels lie is given (`Placement`), and all is turned until the line of sight is z, for the convolutions too.

Legend: B scenes, Q images of a scene, H and W the sides, N pixels of all objects, C channels.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from render.shared.errors import InputError, unknown
from render.shared.progress import stage
from sdps.core.first_normals import first_normals, frames, turn_to_sight
from sdps.core.losses import NormalCriterion, expected_error_loss
from sdps.core.symmetry import Symmetry
from sdps.models.base import FusionNetwork, Observations, Placement, Truth
from sdps.models.blocks import (
    LOG_USUAL,
    SLOPE,
    Exchange,
    LightAttention,
    Surroundings,
    chord_degrees,
    conv,
    deconv,
    pool,
)
from sdps.models.covariance import pack, turn

FRAMES = ("normal", "camera")
_SEEN, _KNOWN = 11, 7
"""Values of a pixel under one light, and those it has under all."""
_DARK = 1e-3
"""Radiance below which nothing is seen; full scale is 1."""
_LARGEST = 2.0
"""Logarithm of the largest distance that is expected, beyond any: odd input must not end in infinity."""
_ERROR_SCALE = 10.0
"""Degrees to expect of a light that count as 1."""
_COVARIANCE = 3.0
"""Factor on covariances: light from all around, a third in each direction, counts as 1."""
_NEAREST = 0.04
"""Squared distance, in a lamp's own, below which pixels are not lit more strongly."""
_MAP = 32
"""Channels of the fused map, without the normals."""
_STRIP = 2**13
"""Pixels times lights that are worked on at once in inference."""
_ROUND = 256
"""In training, pixels are padded to a multiple of this: on CPUs torch compiles new kernels for every new size."""


class Pixels(NamedTuple):
    """Object pixels under their lights."""

    values: Tensor  # (N, Q, 3) float32, exposed images over the light intensities
    directions: Tensor  # (N, Q, 3) float32, unit
    errors: Tensor  # (N, Q) float32, degrees to expect of the directions
    covariances: Tensor | None = None  # (N, Q, 6) float32, of light's directions (`covariance`); None: not told

    def select(self, which: Tensor | slice) -> "Pixels":
        """Return some pixels, in float32."""
        return Pixels(*(None if part is None else part[which].float() for part in self))  # type: ignore[arg-type]

    def round_up(self, multiple: int) -> "Pixels":
        """Return the pixels, padded with copies of the first to a multiple of a number."""
        lacking = -len(self.values) % multiple
        if not lacking:
            return self
        padded = (part if part is None else torch.cat([part, part[:1].expand(lacking, *part.shape[1:])])
                  for part in self)  # fmt: skip
        return Pixels(*padded)  # type: ignore[arg-type]


class FusedMap(NamedTuple):
    """What is known of every pixel once all lights were seen."""

    normals: Tensor  # (B, 3, H, W) float32, unit on the object, as each line of sight sees them
    feature: Tensor  # (B, 32, H, W)
    mask: Tensor  # (B, 1, H, W)
    sights: Tensor | None = None  # (B, 3, H, W) v' of a perspective camera; None: orthographic

    def face(self, normals: Tensor) -> Tensor:
        """Return normals (B, 3, H, W) that lines of sight see in the camera's frame."""
        if self.sights is None:
            return normals
        with torch.autocast(normals.device.type, enabled=False):
            turns = turn_to_sight(self.sights.permute(0, 2, 3, 1).float())  # (B, H, W, 3, 3)
            turned = normals.float().permute(0, 2, 3, 1)[..., None, :] @ turns
        return turned[..., 0, :].permute(0, 3, 1, 2)


class StagedNormals(NamedTuple):
    """What `FrameNet` predicts while it is trained."""

    alone: Tensor  # (B, 3, H, W) unit, by pixels alone
    normals: Tensor  # (B, 3, H, W) unit, corrected by their surroundings
    expected: Tensor  # (B, 1, H, W), distance to the true normals


class FrameNet(FusionNetwork):
    """Normals pixel by pixel in frames of their own, then corrected by their surroundings.

    Args:
        width: C, channels of a light of a pixel.
        blocks: Layers in which the lights of a pixel exchange what they show.
        frame: `normal` for the frame of the first normal; `camera` leaves directions as they are, to compare.
        heads: Of the attention across the lights of a pixel, after the last `attending` of the blocks; 0 for none.
        attending: Layers of attention.
        context: Channels of `Surroundings` at an eighth of the resolution, a multiple of 4; 0 for none.
        covariance: The network is told how far the light of an image is from a single lamp's.
        learn_every: The layers before the fusion learn from every n-th pixel, diagonal by diagonal, and only see the
            others: what pixels of one scene teach is much alike.
    """

    added = ("attend", "surroundings", "about")

    needs_mask = True
    kept_bytes = 6
    equivariant = True
    sees_places = True
    tells_errors = True

    def __init__(
        self, *, width: int = 64, blocks: int = 4, frame: str = "normal", heads: int = 0, attending: int = 2,
        context: int = 0, covariance: bool = False, learn_every: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        if blocks < 1 or width < 1:
            raise InputError(f"width and blocks must be at least 1, got {width} and {blocks}")
        if heads < 0 or (heads and (width % heads or not 0 <= attending <= blocks)):
            raise InputError(f"heads must divide width, and attending be 0 to blocks, got {heads} and {attending}")
        if context < 0 or context % 4:
            raise InputError(f"context must be a multiple of 4, or 0, got {context}")
        if learn_every < 1:
            raise InputError(f"learn_every must be at least 1, got {learn_every}")
        if frame not in FRAMES:
            raise unknown("frame", str(frame), FRAMES)
        self.frame, self.learn_every = frame, learn_every
        self.seen, self.known = nn.Linear(_SEEN, width), nn.Linear(_KNOWN, width)
        self.about = nn.Linear(6, width, bias=False) if covariance else None
        self.exchange = nn.Sequential(*(Exchange(width) for _ in range(blocks)))
        self.attend = nn.ModuleList(LightAttention(width, heads) for _ in range(attending if heads else 0))
        self.fuse = nn.Sequential(
            nn.Linear(2 * width + _KNOWN, 128), nn.LeakyReLU(SLOPE), nn.Linear(128, 128), nn.LeakyReLU(SLOPE)
        )
        self.offset, self.feature = nn.Linear(128, 3), nn.Linear(128, _MAP)
        self.enter = nn.Sequential(conv(_MAP + 4, 64), conv(64, 64))
        self.smaller = nn.Sequential(conv(64, 96, stride=2), conv(96, 96))
        self.quarter = nn.Sequential(conv(96, 128, stride=2), conv(128, 128), conv(128, 128), deconv(128, 96))
        self.surroundings = Surroundings(128, context, 4, 2) if context else None
        self.size_multiple, self.reach = (8, 96) if context else (4, 32)
        self.back = nn.Sequential(conv(192, 96), deconv(96, 64))
        self.leave = nn.Sequential(conv(128, 64), nn.Conv2d(64, 4, 3, padding=1))
        if self.about is not None:
            nn.init.zeros_(self.about.weight)
        # Training begins at the first normals.
        for parameter in (*self.offset.parameters(), *self.leave[-1].parameters()):
            nn.init.zeros_(parameter)

    def predict_stages(self, seen: Observations) -> StagedNormals:
        """Return what is learned: the normals of pixels alone, the corrected ones, and the error to expect of these."""
        fused = self.encode(seen)
        normals, expected = self.correct(fused)
        return StagedNormals(fused.face(fused.normals), normals, expected)

    def loss(self, seen: Observations, truth: Truth, criterion: NormalCriterion) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the losses of the normals at both stages plus, weighted, that of the expected error."""
        stages = self.predict_stages(seen)
        loss, terms = criterion(stages.normals, truth.normals, truth.mask)
        terms["pixel_loss"], _ = criterion(stages.alone, truth.normals, truth.mask)
        terms["expected_loss"] = expected_error_loss(stages.expected, stages.normals, truth.normals, truth.mask)
        return loss + terms["pixel_loss"] + criterion.expected_weight * terms["expected_loss"], terms

    def inference_seconds(self, images: int, pixels: float, box: float, views: int) -> float:
        """Return about how long inference takes: views are turned after the images are fused."""
        return 2.1e-6 * images * pixels + 2.0e-6 * views * box

    def encode(self, seen: Observations) -> FusedMap:
        """Return the fused map of all of a scene's images; what is not learned from, a few pixels at a time."""
        inside, pixels = object_pixels(self._heed(seen))
        if not torch.is_grad_enabled():
            found = self._look(pixels)
        elif self.learn_every == 1:
            found = self._answer(pixels.select(slice(None)), _ROUND)
        else:
            found = self._learn_from_some(pixels, _diagonals(inside, self.learn_every))
        return self._to_map(found, inside, seen.placement)

    def regress(self, feature: FusedMap) -> Tensor:
        return self.correct(feature)[0]

    def regress_with_error(self, feature: FusedMap) -> tuple[Tensor, Tensor | None]:
        normals, distance = self.correct(feature)
        return normals, chord_degrees(distance)

    def correct(self, feature: FusedMap) -> tuple[Tensor, Tensor]:
        """Return unit normals (B, 3, H, W), float32, and the expected distance (B, 1, H, W) to the true ones."""
        normals, fused, mask, _ = feature
        entered = self.enter(torch.cat([normals.to(fused.dtype), fused, mask.to(fused.dtype)], dim=1))
        half = self.smaller(entered)
        quarter = self.quarter[:-1](half)
        if self.surroundings is not None:
            quarter = self.surroundings(quarter)
        back = self.back(torch.cat([self.quarter[-1](quarter), half], dim=1))
        change = self.leave(torch.cat([back, entered], dim=1)).float()
        corrected = functional.normalize(normals + change[:, :3], dim=1)
        return feature.face(corrected), (change[:, 3:] + LOG_USUAL).clamp(max=_LARGEST).exp()

    def turn(self, feature: FusedMap, symmetry: Symmetry) -> FusedMap:
        """Return the fused map of the turned scene: its pixels see their lights in frames that turn with them."""
        normals, fused, mask, *sights = (symmetry.images(each) for each in feature if each is not None)
        normals, *sights = (symmetry.vectors(each, dim=1) for each in (normals, *sights))
        return FusedMap(normals, fused, mask, *sights)

    def accumulate(self, so_far: list[Observations] | None, seen: Observations) -> list[Observations]:
        """Keep the images of a scene, in 16 bits."""
        return [*(so_far or []), self._heed(seen)._replace(images=seen.images.half())]

    def aggregate(self, accumulated: list[Observations]) -> FusedMap:
        """Return the fused map of all of a scene's images, which are never copied as a whole."""
        assert accumulated[0].mask is not None  # the network asks for it
        inside = accumulated[0].mask[:, 0] > 0.5  # (1, H, W)
        directions, errors, nearness, covariances = _all_lights(accumulated)
        placement = accumulated[0].placement
        found = torch.zeros(inside.numel(), 3 + _MAP, device=inside.device)
        places = inside.flatten().nonzero()[:, 0]
        strips = places.split(max(1, _STRIP // directions.shape[1]))
        for number, some in enumerate(strips):
            # Autocast to bfloat16 refuses to join images of 16-bit floats.
            with torch.autocast(inside.device.type, enabled=False):
                values = torch.cat([part.images[0].flatten(2)[..., some] for part in accumulated])  # (Q, 3, n)
            lit_from, unsure = (each.expand(len(some), *each.shape[1:]) for each in (directions, errors))
            told = None if covariances is None else covariances.expand(len(some), -1, -1)
            pixels = Pixels(values.permute(2, 0, 1).float(), lit_from, unsure, told)
            if placement is not None:
                own = Placement(*(each[0].flatten(1)[:, some].T for each in placement))
                pixels = see_lamps(pixels, nearness.expand(len(some), -1), own)
            found[some] = self._per_pixel(pixels).float()
            stage("normals", number + 1, len(strips))
        places_of_all = found.unflatten(0, inside.shape).permute(0, 3, 1, 2)
        sights = None if placement is None else placement.sights
        return FusedMap(places_of_all[:, :3], places_of_all[:, 3:], inside[:, None].float(), sights)

    def _heed(self, seen: Observations) -> Observations:
        """Return observations without covariances where the network is not told them: they would be turned in vain."""
        return seen if self.about is not None else seen._replace(covariance=None)

    def _learn_from_some(self, pixels: Pixels, learned: Tensor) -> Tensor:
        """Return `_per_pixel`, with gradients of the pixels of `learned` (N,) bool alone."""
        some, others = learned.nonzero()[:, 0], (~learned).nonzero()[:, 0]
        found = self._answer(pixels.select(some), _ROUND)
        with torch.no_grad():
            looked = self._look(pixels.select(others))
        whole = found.new_zeros(len(learned), found.shape[1])
        return whole.index_copy(0, some, found).index_copy(0, others, looked)

    def _look(self, pixels: Pixels) -> Tensor:
        """Return `_per_pixel`, a few pixels at a time."""
        count = max(1, _STRIP // pixels.values.shape[1])
        multiple = min(count, _ROUND)
        count -= count % multiple
        parts = range(0, max(1, len(pixels.values)), count)
        return torch.cat([self._answer(pixels.select(slice(start, start + count)), multiple) for start in parts])

    def _answer(self, pixels: Pixels, multiple: int) -> Tensor:
        """Return `_per_pixel` of pixels that are padded to a multiple for it."""
        return self._per_pixel(pixels.round_up(multiple))[: len(pixels.values)]

    def _per_pixel(self, pixels: Pixels) -> Tensor:
        """Return normals and features of pixels, (N, 3 + 32)."""
        with torch.no_grad(), torch.autocast(pixels.values.device.type, enabled=False):
            first, scale, residual = first_normals(pixels.values, pixels.directions)
            camera = torch.eye(3, device=first.device).expand(len(first), 3, 3)
            axes = frames(first) if self.frame == "normal" else camera  # (N, 3, 3)
            start = (axes @ first[..., None])[..., 0]  # the first normal in the frame
            seen, known = pixel_inputs(pixels, axes, start, scale, residual)
            told = None if pixels.covariances is None else _COVARIANCE * turn(pixels.covariances, axes)
        tokens = self.seen(seen) + self.known(known)[:, None]  # (N, Q, C)
        if self.about is not None and told is not None:
            tokens = tokens + self.about(told)
        alone = len(self.exchange) - len(self.attend)  # layers without attention
        for number, layer in enumerate(self.exchange):
            tokens = layer(tokens)
            if number >= alone:
                tokens = self.attend[number - alone](tokens)
        fused = self.fuse(torch.cat([pool(tokens), known.to(tokens.dtype)], dim=-1))  # (N, 128)
        # Never under autocast: a normal rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(fused.device.type, enabled=False):
            local = functional.normalize(start + self.offset(fused.float()), dim=-1)
            normals = (local[:, None] @ axes)[:, 0]
            return torch.cat([normals, self.feature(fused.float())], dim=1)

    def _to_map(self, found: Tensor, inside: Tensor, placement: Placement | None) -> FusedMap:
        """Return what was found of the object's pixels, (N, 3 + 32), in its place; `inside` (B, H, W) bool."""
        places = found.new_zeros(*inside.shape, found.shape[1])
        places[inside] = found
        places = places.permute(0, 3, 1, 2)
        sights = None if placement is None else placement.sights
        return FusedMap(places[:, :3], places[:, 3:], inside[:, None].float(), sights)


def _all_lights(parts: list[Observations]) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Return directions (1, Q, 3), the errors to expect of them and nearness (1, Q), as exact as images are kept, and
    covariances (1, Q, 6) where these are told.
    """
    directions = torch.cat([part.directions for part in parts if part.directions is not None], dim=1)
    errors = [part.light_errors for part in parts if part.light_errors is not None]
    expected = torch.cat(errors, dim=1) if errors else torch.zeros_like(directions[..., 0])
    near = [part.nearness for part in parts if part.nearness is not None]
    nearness = torch.cat(near, dim=1) if near else torch.zeros_like(expected)
    about = [pack(part.covariance) for part in parts if part.covariance is not None]
    covariances = torch.cat(about, dim=1).float() if about else None
    kept = parts[0].images.dtype
    return directions.to(kept).float(), expected.to(kept).float(), nearness.float(), covariances


def _diagonals(inside: Tensor, every: int) -> Tensor:
    """Return which of the pixels of `inside` (B, H, W), in reading order, lie on every so many diagonals: (N,) bool."""
    rows, columns = (torch.arange(side, device=inside.device) for side in inside.shape[1:])
    return ((rows[:, None] + columns) % every == 0).expand_as(inside)[inside]


def object_pixels(seen: Observations) -> tuple[Tensor, Pixels]:
    """Return where the object is, (B, H, W) bool, and its pixels in reading order."""
    assert seen.mask is not None and seen.directions is not None  # the network asks for both
    inside = seen.mask[:, 0] > 0.5
    values = seen.images.permute(0, 3, 4, 1, 2)[inside]  # (N, Q, 3)
    which = torch.arange(len(inside), device=inside.device).repeat_interleave(inside.flatten(1).sum(1))
    errors = torch.zeros_like(seen.directions[..., 0]) if seen.light_errors is None else seen.light_errors
    directions, own_errors = (each[which].to(values.dtype) for each in (seen.directions, errors))
    told = None if seen.covariance is None else pack(seen.covariance)[which].to(values.dtype)
    pixels = Pixels(values, directions, own_errors, told)
    if seen.placement is None:
        return inside, pixels
    own = Placement(*(each.permute(0, 2, 3, 1)[inside] for each in seen.placement))
    nearness = torch.zeros_like(errors) if seen.nearness is None else seen.nearness
    return inside, see_lamps(pixels, nearness[which], own)


def see_lamps(pixels: Pixels, nearness: Tensor, own: Placement) -> Pixels:
    """Return pixels under lamps of nearness (N, Q) as their lines of sight see them; `own` holds (N, 3) each."""
    with torch.autocast(nearness.device.type, enabled=False):
        off = pixels.directions.float() - nearness.float()[..., None] * own.places.float()[:, None]  # (N, Q, 3)
        squared = off.square().sum(dim=-1).clamp(min=_NEAREST)
        turns = turn_to_sight(own.sights.float())
        towards = (off / squared.sqrt()[..., None]) @ turns.transpose(1, 2)
        covariances = None if pixels.covariances is None else turn(pixels.covariances.float(), turns)
    return Pixels(pixels.values * squared[..., None], towards, pixels.errors, covariances)


def pixel_inputs(pixels: Pixels, axes: Tensor, start: Tensor, scale: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the network is given of each light of a pixel, (N, Q, 11), and of the pixel, (N, 7).

    Args:
        pixels: What they showed.
        axes: (N, 3, 3), rows are x, y and z of each pixel's frame.
        start: (N, 3), the first normal in the frame.
        scale: (N, 3), radiance of a Lambertian surface of the pixel's colour that faces the light.
        residual: (N,), mean absolute error of that surface, relative to `scale`.
    """
    values, directions, errors, _ = pixels
    relative = values / (scale + 0.1 * scale.mean(dim=1, keepdim=True) + _DARK)[:, None]  # all equal on matte surfaces
    local = directions @ axes.transpose(1, 2)  # (N, Q, 3)
    view = axes[:, :, 2]  # (N, 3), z of the camera
    half = functional.normalize(local + view[:, None], dim=-1)
    # Brightness as exposed shows what is noise and what is clipped. The inverse hyperbolic sine keeps highlights in
    # range, and zero at zero.
    brightness = torch.asinh(4.0 * values.mean(dim=-1, keepdim=True))
    error = errors[..., None] / _ERROR_SCALE
    seen = torch.cat([torch.asinh(2.0 * relative), local, half, brightness, error], dim=-1)
    facing = (view * start).sum(dim=1, keepdim=True)
    known = torch.cat([start[:, :2], facing, torch.log(scale + _DARK), residual[:, None]], dim=-1)
    return seen, known
