"""Training of CNN-PS on our scenes: pixels drawn from a batch, each with lights of its own.

The published training set has 1,300 lights per pixel to draw from and materials that change between superpixels; here
the lights are those of a batch's images, and the variety of materials comes from scenes whose materials vary over the
surface.

Legend: B scenes, Q lights, P pixels of a scene, N = B P.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from render.shared.seeds import derive_seed
from sdps.core.metrics import angle_degrees
from sdps.data.dataset import Batch
from sdps.models.base import Lights
from sdps.models.cnnps import observation_maps, predict_normals, rotate_about_view
from sdps.training.stages import NormalStage
from sdps.training.training_config import PixelTraining

VALIDATION_ROTATIONS = 3
"""The test averages over `PixelTraining.rotations`; a third of them shows progress just as well."""
VALIDATION_PIXELS = 256
"""PixelSamples of a scene that are validated on, evenly spread over its mask."""
_CUT_DEGREES = (20.0, 90.0)
_TINY = 1e-8


class PixelSamples(NamedTuple):
    """PixelSamples and what they showed under each light."""

    values: Tensor  # (N, Q) float32, grey radiance under lights of intensity 1
    directions: Tensor  # (N, Q, 3) float32, unit
    valid: Tensor  # (N, Q) bool, the lights given
    normals: Tensor  # (N, 3) float32, unit


class PixelStage(NormalStage):
    """CNN-PS learns the normals of single pixels, under true lights or those of a frozen lighting model.

    Args:
        config: The run's configuration; images are taken whole, and `crop` and `loss` are not looked at.
        lighting: Trained lighting model, where `config.lights` names one.
        model: Name in the registry.
        name: Name of the run.
    """

    config: PixelTraining
    usual = "cnnps"

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the mean squared error of the unit normals' components, as published, over pixels drawn at random.

        A scene without object pixels adds zero.
        """
        config = self.config
        lights = self.training_lights(batch)
        assert lights is not None  # a pixel network is always given them
        pixels = draw_pixels(
            batch, lights, batch.seed.tolist(), count=config.pixels_per_scene, min_lights=config.min_lights
        )
        normals = self.network(observation_maps(pixels.values, pixels.directions, pixels.valid))  # (N, 3)
        squares = (normals - pixels.normals).square().sum()
        return squares / (3 * config.pixels_per_scene * len(batch.images)), {}

    def metrics(self, batch: Batch) -> dict[str, float]:
        """Return loss and normal MAE over an even sample of the object's pixels, each given all lights."""
        lights = self.lights(batch)
        assert lights is not None  # a pixel network is always given them
        pixels = sample_pixels(batch, lights, VALIDATION_PIXELS)
        rotations = min(self.config.rotations, VALIDATION_ROTATIONS)
        normals = predict_normals(self.network, *pixels[:3], rotations=rotations)
        errors = angle_degrees(normals.cpu().numpy(), pixels.normals.cpu().numpy())
        values = {"loss": 0.0, "normal_mae": 0.0}
        if len(errors):
            squares = (normals - pixels.normals).square()
            values = {"loss": float(squares.mean()), "normal_mae": float(errors.mean())}
        return values | self.light_scores(lights, batch)


def draw_pixels(batch: Batch, lights: Lights, seeds: Sequence[int], *, count: int, min_lights: int) -> PixelSamples:
    """Draw object pixels of every scene, with replacement, each with a random subset of the lights, turned at random.

    A pixel keeps the lights whose angle from the view axis is below a limit uniform in [20, 90] degrees, and of these
    at most a number uniform in {`min_lights`, ..., Q}; it always keeps `min_lights` of them (all, where there are
    fewer), if need be those nearest to the axis. Lights and normal are turned together about the axis by a uniform
    angle.

    Args:
        batch: Scenes; images and normals are taken whole; their crop is not looked at.
        lights: Directions given to the network, and intensities the images are divided by.
        seeds: One per scene. They alone determine what is drawn, on any device and in any split of the batch.
        count: P, pixels per scene; a scene without object pixels gives none.
        min_lights: Fewest lights of a pixel.
    """
    return _join([_draw_scene(batch, lights, scene, seed, count, min_lights) for scene, seed in enumerate(seeds)])


def sample_pixels(batch: Batch, lights: Lights, count: int) -> PixelSamples:
    """Return at most `count` object pixels of every scene, evenly spaced in reading order, under all lights."""
    scenes = []
    for scene in range(len(batch.images)):
        inside = _inside(batch, scene)
        place = torch.linspace(0, max(len(inside) - 1, 0), min(count, len(inside)), dtype=torch.float64)
        scenes.append(_gather(batch, lights, scene, inside[place.round().long().to(inside.device)]))
    return _join(scenes)


def _draw_scene(batch: Batch, lights: Lights, scene: int, seed: int, count: int, min_lights: int) -> PixelSamples:
    # Always on the CPU: generators of different devices give different numbers.
    rng = torch.Generator().manual_seed(derive_seed(seed, "pixels"))
    inside = _inside(batch, scene)
    if not len(inside):
        return _gather(batch, lights, scene, inside)
    chosen = torch.randint(len(inside), (count,), generator=rng)
    pixels = _gather(batch, lights, scene, inside[chosen.to(inside.device)])
    directions = lights.directions[scene].float().cpu()  # (Q, 3)
    valid = draw_lights(directions, count, min(min_lights, len(directions)), rng)
    angles = (2.0 * math.pi * torch.rand(count, generator=rng)).to(pixels.values.device)  # (P,)
    return PixelSamples(
        values=pixels.values,
        directions=rotate_about_view(pixels.directions, angles[:, None]),
        valid=valid.to(pixels.values.device),
        normals=rotate_about_view(pixels.normals, angles),
    )


def draw_lights(directions: Tensor, count: int, min_lights: int, rng: torch.Generator) -> Tensor:
    """Return which of the lights (Q, 3) each of `count` pixels keeps, (P, Q) bool; see `draw_pixels`."""
    lights = len(directions)
    low, high = _CUT_DEGREES
    cut = low + (high - low) * torch.rand(count, 1, generator=rng)  # (P, 1)
    numbers = torch.randint(min_lights, lights + 1, (count, 1), generator=rng)  # (P, 1)
    keys = torch.rand(count, lights, generator=rng)  # (P, Q)
    angles = torch.rad2deg(directions[:, 2].clamp(-1.0, 1.0).acos())  # (Q,)
    allowed = (angles < cut) | (_ranks(angles) < min_lights)  # (P, Q)
    return allowed & (_ranks(torch.where(allowed, keys, 2.0)) < numbers)


def _ranks(values: Tensor) -> Tensor:
    """Return the place of each value in the ascending order of its row."""
    return values.argsort(dim=-1, stable=True).argsort(dim=-1)


def _inside(batch: Batch, scene: int) -> Tensor:
    """Return the flat positions of a scene's object pixels."""
    return batch.mask[scene, 0].flatten().nonzero()[:, 0]


def _gather(batch: Batch, lights: Lights, scene: int, places: Tensor) -> PixelSamples:
    """Return the pixels at flat positions (P,) of a scene under all lights."""
    grey = batch.images[scene].flatten(2)[..., places].mean(dim=1)  # (Q, P)
    values = (grey / (lights.intensities[scene][:, None] + _TINY)).T.float()  # (P, Q)
    return PixelSamples(
        values=values,
        directions=lights.directions[scene].float().expand(len(places), -1, -1),
        valid=torch.ones_like(values, dtype=torch.bool),
        normals=batch.normals[scene].flatten(1)[:, places].T,
    )


def _join(scenes: list[PixelSamples]) -> PixelSamples:
    return PixelSamples(*(torch.cat(parts) for parts in zip(*scenes, strict=True)))
