"""Training samples made on the device that trains, a batch at a time, of scenes that lie in its memory.

A processor core makes eight samples a second; a GPU learns from hundreds. So scenes are read, shrunk and laid out once
(`prepare`), and all that is random happens on the device: which lights, symmetry, exposure, camera, crop. A sample
is made as by `sdps.data.dataset.make_sample`, with which it is compared; only its random numbers are others.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from sdps.core.symmetry import SYMMETRIES
from sdps.data.augment import Augmentation
from sdps.data.dataset import CROP_DRAWS, Batch, SampleOptions, choose_images, resize
from sdps.data.resident.device_sensor import Sensors, record
from sdps.data.sample_geometry import lay_out, place
from sdps.data.scene_store import StoredScene

_MAPS = 10
"""Channels of a scene's maps: mask, normals, places, sights."""


class Prepared(NamedTuple):
    """A scene as samples are made of it."""

    images: np.ndarray  # (L, 3, S, S) float16, radiance under lamps of irradiance pi at the object's middle
    maps: np.ndarray  # (10, S, S) float32: mask, normals, places, sights as in `Batch`
    directions: np.ndarray  # (L, 3) float32
    nearness: np.ndarray  # (L,) float32


class Held:
    """Scenes in the memory of a device.

    Args:
        room: How many at most.
        lights: L, of each.
        side: S, of their images.
        device: Where.
    """

    def __init__(self, room: int, lights: int, side: int, device: torch.device) -> None:
        self.images = torch.zeros((room, lights, 3, side, side), dtype=torch.float16, device=device)
        self.maps = torch.zeros((room, _MAPS, side, side), device=device)
        self.directions = torch.zeros((room, lights, 3), device=device)
        self.nearness = torch.zeros((room, lights), device=device)
        self.towards = np.zeros((room, lights, 3), np.float32)  # the directions, for choices made on the processor
        self.count = 0

    @staticmethod
    def bytes_each(lights: int, side: int) -> int:
        """Return the memory of one scene."""
        return side * side * (lights * 3 * 2 + _MAPS * 4)

    def add(self, scene: Prepared) -> None:
        """Take a scene in; it counts once it is there as a whole."""
        place = self.count
        self.towards[place] = scene.directions
        for kept, part in zip((self.images, self.maps, self.directions, self.nearness), scene, strict=True):
            kept[place].copy_(torch.from_numpy(part))
        self.count = place + 1


def prepare(scene: SceneSpec, stored: StoredScene, size: int) -> Prepared:
    """Return a scene, stored or just rendered, as samples are made of it.

    Args:
        scene: Manifest line.
        stored: Its images and ground truth.
        size: Side in pixels to which it is brought.

    Raises:
        InputError: another number of images than of lights.
    """
    directions = scene.light_directions()
    if len(stored.images) != len(directions):
        raise InputError(f"scene {scene.id}: {len(stored.images)} images for {len(directions)} lights; render it again")
    layout = lay_out(scene, stored.depth, stored.mask, np.arange(len(directions)))
    images = stored.images[:].astype(np.float32)
    images, normals, mask, layout = resize(images, stored.normals, stored.mask, layout, size)
    placed = place(layout, mask, directions)
    images = images / placed.irradiance[:, None, None, None]
    maps = np.concatenate([mask[..., None], normals, placed.places, placed.sights], axis=-1)
    return Prepared(
        images=np.ascontiguousarray(images.transpose(0, 3, 1, 2).clip(-6e4, 6e4), np.float16),
        maps=np.ascontiguousarray(maps.transpose(2, 0, 1), np.float32),
        directions=placed.directions, nearness=placed.nearness,
    )  # fmt: skip


def require_possible(options: SampleOptions) -> None:
    """Refuse samples that are not made on a device.

    Raises:
        InputError: mixed light, the paper's exposure, or a random scale.
    """
    config = options.augmentation
    wrong = {"augmentation.mixed": config.mixed is not None, "rescale": options.rescale,
             "augmentation.exposure: paper": config.exposure == "paper"}  # fmt: skip
    for name, given in wrong.items():
        if given:
            raise InputError(f"resident: samples with {name} are made by loader processes only; set resident to false")


@torch.no_grad()
def make_batch(held: Held, numbers: np.ndarray, options: SampleOptions, rng: np.random.Generator) -> Batch:
    """Return a batch of B scenes, in no particular order.

    Args:
        held: The scenes.
        numbers: (B,) which of them.
        options: How samples are made.
        rng: Draws everything random.
    """
    device = held.images.device
    if options.fewest:
        options = replace(options, images=int(rng.integers(options.fewest, options.images, endpoint=True)))
    noise = torch.Generator(device).manual_seed(int(rng.integers(2**63)))
    turns = np.sort(rng.integers(len(SYMMETRIES), size=len(numbers)) * options.augmentation.symmetries)
    chosen = np.stack([choose_images(held.towards[number], options, rng) for number in numbers])  # (B, Q)
    which, rows = torch.from_numpy(chosen).to(device), torch.from_numpy(np.asarray(numbers)).to(device)[:, None]
    images, maps = held.images[rows, which].float(), held.maps[rows[:, 0]]
    directions, nearness = held.directions[rows, which], held.nearness[rows, which]
    images, maps, directions = _turn(turns, images, maps, directions)
    images, intensities = _expose(images, maps[:, :1], options.augmentation, rng, noise)
    corner = torch.zeros((len(numbers), 2), dtype=torch.long, device=device)
    if options.crop:
        corner = crop_corners(maps[:, :1], options.crop, options.min_object, noise)
    return Batch(
        images=images, mask=maps[:, :1], normals=maps[:, 1:4], directions=directions, intensities=intensities,
        corner=corner, seed=torch.from_numpy(rng.integers(2**63, size=len(numbers))), nearness=nearness,
        covariance=nearness.new_zeros(*nearness.shape, 3, 3),
        places=maps[:, 4:7], sights=maps[:, 7:],
    )  # fmt: skip


def _turn(turns: np.ndarray, images: Tensor, maps: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return scenes turned, each by a symmetry of its own; the numbers of these (B,) rise."""
    parts = []
    for number in np.unique(turns):
        symmetry, some = SYMMETRIES[number], slice(*np.searchsorted(turns, [number, number + 1]))
        turned = symmetry.images(maps[some])
        vectors = [symmetry.vectors(each, dim=1) for each in turned[:, 1:].split(3, dim=1)]
        parts.append((symmetry.images(images[some]), torch.cat([turned[:, :1], *vectors], dim=1),
                      symmetry.vectors(directions[some])))  # fmt: skip
    images, maps, directions = (torch.cat(each) for each in zip(*parts, strict=True))
    return images, maps, directions


def _expose(
    images: Tensor, mask: Tensor, config: Augmentation, rng: np.random.Generator, noise: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return images (B, Q, 3, S, S) as cameras recorded them, and intensities (B, Q): `augment` of exposure `mean`."""
    scenes, device = len(images), images.device
    drawn = rng.uniform(*config.intensity_range, images.shape[:2]).astype(np.float32)
    factors = torch.from_numpy(rng.uniform(*config.mean_jitter, scenes).astype(np.float32)).to(device)
    intensities = torch.from_numpy(drawn).to(device)
    images = images * intensities[..., None, None, None]
    if config.sensor is not None:
        cameras = Sensors.of([config.sensor.draw(rng) for _ in range(scenes)], device)
        images = images * (exposure_scales(images, mask, config.mean_level, config.clip) / config.clip)
        images = record(images, cameras, noise) * config.clip
    scale = exposure_scales(images, mask, config.mean_level, config.clip)
    images = (images * (scale * factors[:, None, None, None, None])).clamp(max=config.clip)
    if config.noise:
        images = images + config.noise * (torch.rand(images.shape, generator=noise, device=device) - 0.5)
    return images, intensities


def exposure_scales(images: Tensor, mask: Tensor, level: float, clip: float) -> Tensor:  # (B, 1, 1, 1, 1)
    """Return the factor s of each scene for which the mean of min(s images, clip) is `level`; 1 for black ones.

    Args:
        images: (B, Q, 3, S, S).
        mask: (B, 1, S, S), 0 or 1: where the mean is taken.
        level: Mean wanted.
        clip: Where images saturate.
    """
    inside = mask[:, None]
    count = inside.sum(dim=(1, 2, 3, 4), keepdim=True) * images.shape[1] * images.shape[2]

    def mean(values: Tensor) -> Tensor:
        return (values * inside).sum(dim=(1, 2, 3, 4), keepdim=True) / count.clamp(min=1.0)

    average = mean(images)
    lit = average > 0.0
    scale = torch.where(lit, level / average.clamp(min=1e-20), 1.0)
    for _ in range(5):
        clipped = mean((images * scale).clamp(max=clip))
        done = (clipped > 0.99 * level) | ~lit
        scale = torch.where(done, scale, scale * (level / clipped.clamp(min=1e-20)))
    return scale


def crop_corners(mask: Tensor, side: int, least: float, noise: torch.Generator) -> Tensor:  # (B, 2) int64
    """Draw a crop's corner for each scene, around a random object pixel: the first with enough object, else the best.

    Args:
        mask: (B, 1, S, S), 0 or 1.
        side: Of the crop.
        least: Share of object pixels wanted.
        noise: Draws.
    """
    size = mask.shape[-1]
    weights = mask.flatten(1) + (mask.flatten(1).sum(dim=1, keepdim=True) == 0)
    pixels = torch.multinomial(weights, CROP_DRAWS, replacement=True, generator=noise)  # (B, 8)
    places = torch.stack([pixels // size, pixels % size], dim=-1)  # (B, 8, 2)
    corners = (places - side // 2).clamp(0, size - side)
    shares = functional.avg_pool2d(mask, side, stride=1)[:, 0]  # (B, S - side + 1, S - side + 1)
    scenes = torch.arange(len(mask), device=mask.device)[:, None]
    share = shares[scenes, corners[..., 0], corners[..., 1]]  # (B, 8)
    order = torch.arange(CROP_DRAWS, device=mask.device)
    best = torch.where(share >= least, 2.0 + CROP_DRAWS - order, share).argmax(dim=1)
    return corners[scenes[:, 0], best]
