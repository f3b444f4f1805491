"""From scenes to training samples, the same ones however many workers make them.

The position in an endless stream of samples determines everything about a sample: scene, images,
augmentation, crop. So a run is resumed exactly by one integer, and no two workers share a random stream.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset

from render.records.manifest import SceneSpec
from render.records.mirror import describe_packing
from render.shared.errors import InputError
from render.shared.imaging.mixing import LightStage, mix, require_enough
from render.shared.seeds import generator
from sdps.core.symmetry import Symmetry
from sdps.data.augment import Augmentation, augment
from sdps.data.sample_geometry import Layout, lay_out, place
from sdps.data.scene_store import PackedImages, SceneStore, StoredScene, list_finished, require_equal_counts

CROP_DRAWS = 8
_WITH_DECODED = 2.5  # bytes of shards and decoded scenes together, over those of the shards


class Batch(NamedTuple):
    """Tensors of B scenes with Q images each; a single sample has the same fields without B."""

    images: Tensor  # (B, Q, 3, S, S) float32, augmented
    mask: Tensor  # (B, 1, S, S) float32, 0 or 1
    normals: Tensor  # (B, 3, S, S) float32, unit, zero outside the mask
    directions: Tensor  # (B, Q, 3) float32, unit
    intensities: Tensor  # (B, Q) float32
    corner: Tensor  # (B, 2) int64, row and column of the crop's upper left corner
    seed: Tensor  # (B,) int64, non-negative, of the sample alone: for randomness a stage adds
    nearness: Tensor  # (B, Q) float32, rho of the lamps (`sdps.core.geometry`), 0 of distant ones
    places: Tensor  # (B, 3, S, S) float32, where pixels lie, in the object's radii from its middle; 0 outside the mask
    sights: Tensor  # (B, 3, S, S) float32, towards the camera, z = 1
    covariance: Tensor  # (B, Q, 3, 3) float32, of the directions that an image's light comes from, 0 of single lamps

    def to(self, device: torch.device) -> "Batch":
        """Copy every tensor to `device`."""
        return Batch(*(tensor.to(device, non_blocking=True) for tensor in self))


class SampleKey(NamedTuple):
    """Which sample: the index of its scene, and its place in the stream."""

    scene: int
    epoch: int
    position: int


@dataclass(frozen=True, kw_only=True)
class SampleOptions:
    """How a sample is made from a scene.

    Attributes:
        seed: Root seed.
        images: Images drawn per scene (all, in random order, where a scene has fewer).
        fewest: Of batches made on a device: each has so many images to `images`; 0: always `images`.
        size: Side in pixels.
        crop: Side of the random crop, 0 for none.
        min_object: Least share of object pixels wanted in a crop.
        augmentation: How images are altered.
        rescale: Scenes larger than `size` are shrunk by a random factor and cropped to `size` at random, instead of
            shrunk to it (`_rescale`); off in the paper, whose scenes are 128 pixels wide.
    """

    seed: int
    images: int
    fewest: int = 0
    size: int = 128
    crop: int = 0
    min_object: float = 0.3
    augmentation: Augmentation
    rescale: bool = False


class SceneDataset(Dataset[Any]):
    """Samples of the scenes of one split of a data folder, indexed by `SampleKey`.

    Args:
        folder: Data folder with a manifest and shards.
        split: `train`, `val` or `test`; the split also names the random stream.
        options: How samples are made.
        cache: Keep decoded scenes in `<folder>/cache`, unless the folder is packed and larger than its cache.
        skip_missing: Leave out planned scenes that have no shard instead of refusing. Scenes that could not be
            rendered (`failed.jsonl`) are left out in any case, with a warning.

    Raises:
        InputError: no manifest, no scene of the split, or missing shards.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str,
        options: SampleOptions,
        *,
        cache: bool = True,
        skip_missing: bool = False,
    ) -> None:
        self.split = split
        self.options = options
        self.scenes = list_finished(Path(folder), split, skip_missing=skip_missing)
        self.packed = describe_packing(Path(folder), self.scenes)
        # Scenes of a set that does not fit would leave the cache before they are used a second time.
        fits = self.packed is None or self.packed.limit > _WITH_DECODED * self.packed.size
        self.store = SceneStore(Path(folder), cache=cache and fits)
        require_lights(folder, self.scenes, options)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, key: SampleKey) -> Batch | InputError:
        # An InputError is returned, not raised: torch would wrap one raised in a worker into a multi-line text.
        try:
            return self.sample(key)
        except InputError as error:
            return error

    def sample(self, key: SampleKey) -> Batch:
        """Make the sample `key` names.

        Raises:
            InputError: the shard is damaged or differs from the manifest.
        """
        rng = generator(self.options.seed, "sample", self.split, key.epoch, key.position)
        scene = self.scenes[key.scene]
        return make_sample(scene, self.store.load(scene), self.options, rng)


def require_lights(where: str | Path, scenes: Sequence[SceneSpec], options: SampleOptions) -> None:
    """Refuse scenes whose lights samples cannot be made of.

    Raises:
        InputError: too few for equally many images, or for light that is mixed; or an environment that is not a map.
    """
    require_equal_counts(where, scenes, options.images)
    mixed = options.augmentation.mixed
    if mixed is not None:
        if not mixed.sparse:
            require_enough(min(len(scene.lights) for scene in scenes), str(where))
        mixed.load()


def make_sample(scene: SceneSpec, stored: StoredScene, options: SampleOptions, rng: np.random.Generator) -> Batch:
    """Make a training sample of a scene, stored or just rendered.

    The order is that of the authors' loader: a random subset of the images, in random order; rescaling and cropping;
    exposure, intensities and noise (`sdps.data.augment`).

    Args:
        scene: Manifest line; the light directions are always those of the manifest, with which a shard must agree.
        stored: Its images and ground truth.
        options: How the sample is made.
        rng: Draws everything random, and has drawn nothing yet.

    Returns:
        The fields of a `Batch` without B.

    Raises:
        InputError: another number of images than of lights.
    """
    # A child of the stream, so that the number does not depend on how much the sample draws.
    seed = int(rng.spawn(1)[0].integers(2**63))
    images, chosen, weights = _draw_images(scene, stored.images, options, rng)
    normals, mask, directions = stored.normals, stored.mask, scene.light_directions()[chosen]
    layout = lay_out(scene, stored.depth, mask, chosen)
    if options.augmentation.symmetries:
        symmetry = Symmetry(int(rng.integers(4)), bool(rng.integers(2)))
        images, normals, mask = symmetry.images(images, 1), symmetry.images(normals, 0), symmetry.images(mask, 0)
        normals, directions, layout = symmetry.vectors(normals), symmetry.vectors(directions), layout.turn(symmetry)
    if options.rescale and min(mask.shape) > options.size:
        images, normals, mask, layout = _rescale(images, normals, mask, layout, options, rng)
    images, normals, mask, layout = resize(images, normals, mask, layout, options.size)
    placed = place(layout, mask, directions)
    if weights is not None:
        placed = placed.mix(weights)
    elif layout.positions is not None:
        images = images / placed.irradiance[:, None, None, None]
    images, intensities = augment(images, mask, options.augmentation, rng)
    strengths = intensities if weights is None else intensities * placed.irradiance
    corner = _crop_corner(mask, options.crop, options.min_object, rng) if options.crop else (0, 0)
    return Batch(
        images=_channels_first(images), mask=torch.from_numpy(mask[None].astype(np.float32)),
        normals=_channels_first(normals), directions=torch.from_numpy(placed.directions),
        intensities=torch.from_numpy(strengths), corner=torch.tensor(corner), seed=torch.tensor(seed),
        nearness=torch.from_numpy(placed.nearness), covariance=torch.from_numpy(placed.covariance),
        places=_channels_first(placed.places), sights=_channels_first(placed.sights),
    )  # fmt: skip


def _channels_first(pictures: np.ndarray) -> Tensor:  # (..., 3, H, W) float32
    """Return pictures (..., H, W, 3) as networks take them."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(pictures, -1, -3), dtype=np.float32))


def _draw_images(
    scene: SceneSpec, images: np.ndarray | PackedImages, options: SampleOptions, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return images (Q, H, W, 3) float32, and which lights of the scene are meant: one each, without shares of them.

    Images of mixed light have shares (Q, L) of all lights.
    """
    directions, mixed = scene.light_directions(), options.augmentation.mixed
    if len(images) != len(directions):
        raise InputError(f"scene {scene.id}: {len(images)} images for {len(directions)} lights; render it again")
    if mixed is None:
        chosen = choose_images(directions, options, rng)
        return images[chosen].astype(np.float32), chosen, None
    stage = LightStage(directions, f"scene {scene.id}", sparse=mixed.sparse)
    weights, _ = mixed.draw(stage, options.images, rng)
    packed = PackedImages.of(images)
    return PackedImages(mix(packed.values, weights), packed.kept)[:], np.arange(len(directions)), weights.mean(-1)


def choose_images(directions: np.ndarray, options: SampleOptions, rng: np.random.Generator) -> np.ndarray:  # (Q,)
    """Draw which of a scene's images a sample has, in random order.

    A biased sample has those around one direction, a frontal one those around the camera's.
    """
    biased, shares = options.augmentation.biased, options.augmentation.biased + options.augmentation.frontal
    count, kind = len(directions), rng.random() if shares else 1.0
    if kind >= shares:
        return rng.permutation(count)[: options.images]
    if kind < biased:
        radius, angle = np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)  # uniform over the unit disc
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)])
    else:
        centre = np.array([0.0, 0.0, 1.0])
    nearest = np.argsort(-(directions @ centre), kind="stable")
    kept = rng.integers(options.images, max(options.images, count // 2), endpoint=True)
    return rng.permutation(nearest[:kept])[: options.images]


def collate(samples: Sequence[Batch | InputError]) -> Batch | InputError:
    """Stack samples into a batch, or pass on the first error a worker met."""
    whole = []
    for sample in samples:
        if isinstance(sample, InputError):
            return sample
        whole.append(sample)
    return Batch(*(torch.stack(tensors) for tensors in zip(*whole, strict=True)))


def _rescale(
    images: np.ndarray, normals: np.ndarray, mask: np.ndarray, layout: Layout, options: SampleOptions,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Layout]:  # fmt: skip
    """Cut the square window that, brought to `size`, is the scene shrunk at random and then cropped at random.

    Two deviations from the authors' loader. It draws the new height and width apart from each other, in [128, H) and
    [128, W), and leaves the normals as they were, though unequal scaling alters those of the surface shown; here both
    axes share one factor, with which the normals stay right, the shorter side's new length being uniform in
    [size, its own]. And the window lies about a random pixel of the object, since background alone teaches nothing.
    """
    shorter = min(mask.shape)
    side = round(options.size * shorter / rng.integers(options.size, shorter, endpoint=True))
    row, column = _crop_corner(mask, side, options.min_object, rng)
    window = np.s_[row : row + side, column : column + side]
    return images[:, *window], normals[window], mask[window], layout.select(window)


def resize(
    images: np.ndarray, normals: np.ndarray, mask: np.ndarray, layout: Layout, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Layout]:
    """Bring a scene of another size to (size, size), normals to unit length, the mask to its majority."""
    if images.shape[1:3] == (size, size):
        return images, normals, mask, layout
    laid = np.concatenate([layout.image, layout.depth[..., None]], axis=-1)
    stack = np.concatenate([images, laid[None], normals[None], np.repeat(mask[None, ..., None], 3, -1)])
    stack = stack.astype(np.float32)
    tensor = torch.from_numpy(np.ascontiguousarray(stack.transpose(0, 3, 1, 2)))
    shrunk = functional.interpolate(tensor, (size, size), mode="bilinear", antialias=True)
    resized = shrunk.numpy().transpose(0, 2, 3, 1)
    (images, laid, normals), share = (resized[:-3], *resized[-3:-1]), resized[-1, ..., 0]
    mask = share > 0.5
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    # Depth is 0 outside the object: what is averaged there counts for nothing.
    depth = np.where(mask, laid[..., 2] / np.maximum(share, 0.5), 0.0).astype(np.float64)
    layout = layout._replace(image=laid[..., :2].astype(np.float64), depth=depth)
    return images, np.where(mask[..., None], normals / np.maximum(length, 1e-6), 0.0), mask, layout


def _crop_corner(mask: np.ndarray, side: int, min_object: float, rng: np.random.Generator) -> tuple[int, int]:
    """Draw a crop's corner around a random object pixel; the first with enough object, else the best."""
    rows, columns = np.nonzero(mask)
    last = mask.shape[0] - side, mask.shape[1] - side
    best, best_share = (last[0] // 2, last[1] // 2), -1.0
    for _ in range(CROP_DRAWS if len(rows) else 0):
        pixel = rng.integers(len(rows))
        places = zip((rows[pixel], columns[pixel]), last, strict=True)
        row, column = (int(np.clip(place - side // 2, 0, limit)) for place, limit in places)
        share = float(mask[row : row + side, column : column + side].mean())
        if share >= min_object:
            return row, column
        if share > best_share:
            best, best_share = (row, column), share
    return best
