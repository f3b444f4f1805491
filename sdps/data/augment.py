"""From rendered radiance to what a camera under unequal lights would have recorded.

Shards hold HDR radiance: a dark material is really dark (0.01), a mirror's highlight reaches hundreds.
The paper instead starts from 8-bit images. Two exposure modes bridge that:

* `paper`: the sensor's clip, one random factor per scene, random light intensities, noise: the authors' order exactly
  (their 8-bit files have saturated before).
* `mean`: random light intensities first, then the whole set is exposed so that the object's mean is at a
  fixed level, as a photographer would, with a jitter, then the clip and noise. Test images are brought
  to the same level, so that absolute brightness carries no spurious meaning.

With a `sensor` a camera drawn for the sample records the images where the clip stands in this order: saturation, noise
and rounding come before what scales the images later. In `mean` the camera's images are then exposed once more, as test
images are.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.imaging.scene_mixing import SceneMix
from render.shared.imaging.sensor import SensorModel

PAPER_TEST_FLOOR, PAPER_TEST_GAIN, PAPER_TEST_CLIP = 0.02, 1.5, 2.0
"""How GCNet's loader exposes HDR test sets: object mean at least 0.02, then x1.5, clipped at 2."""


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How the images of a scene are altered on every access.

    Attributes:
        exposure: `mean` (expose the set to a common object mean) or `paper` (one random factor).
        exposure_range: Uniform range of the factor (`paper`); (1, 3) in the paper.
        mean_level: Mean radiance of the object's pixels over the set after exposure (`mean`).
        mean_jitter: Uniform range of the factor on `mean_level`.
        clip: Sensor saturation. `mean` clips exposed images, `paper` the radiance as it was rendered. Unclipped
            highlights reach hundreds; a network that sees them learns more slowly (docs/studies/model-comparison.md).
        intensity_range: Uniform range of the light intensity of each image; the labels of LCNet.
        noise: Full width of the uniform noise added to every pixel, background included.
        biased: Share of the samples whose lights are not all around: those nearest to a random direction, at most half
            of a scene's. What a network fuses over the images depends on which lights there are.
        frontal: Share of the samples with the lights nearest to the camera, at most half of a scene's. Real sets are
            often so (DiLiGenT's lights all lie within 45 degrees of it); of biased samples next to none are.
        symmetries: Mirror and quarter-turn scenes at random, with their normals and lights (not in the
            paper): eight views for the price of one rendering.
        sensor: Cameras that record the images (`render.shared.imaging.sensor`); without it they clip and no more. Set
            `noise` to 0 with it.
        mixed: Light of the images, mixed again for every sample from all lights of its scene
            (`render.shared.imaging.scene_mixing`), which must be a dense light stage unless it is `sparse`; without it
            each image has one light. For networks that are given no lights; a sample's directions are then where the
            light comes from on average.
    """

    exposure: Literal["mean", "paper"] = "mean"
    exposure_range: tuple[float, float] = (1.0, 3.0)
    mean_level: float = 0.3
    mean_jitter: tuple[float, float] = (0.7, 1.4)
    clip: float = 1.0
    intensity_range: tuple[float, float] = (0.2, 2.0)
    noise: float = 0.05
    biased: float = 0.0
    frontal: float = 0.0
    symmetries: bool = False
    sensor: SensorModel | None = None
    mixed: SceneMix | None = None

    def __post_init__(self) -> None:
        for name in ("exposure_range", "mean_jitter", "intensity_range"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise InputError(f"augmentation.{name} needs 0 < low <= high, got {low} and {high}")
        check_fields(self, "positive", "mean_level", "clip", section="augmentation")
        if self.mean_level >= self.clip:
            raise InputError(f"augmentation.mean_level {self.mean_level} must be below augmentation.clip {self.clip}")
        for name in ("biased", "frontal"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"augmentation.{name} must be in [0, 1], got {getattr(self, name)}")
        if self.mixed is not None and self.biased + self.frontal:
            raise InputError("augmentation.mixed takes all lights of a scene; set biased and frontal to 0")
        if self.biased + self.frontal > 1.0:
            raise InputError(f"augmentation.frontal must leave biased its share {self.biased}, got {self.frontal}")
        if not 0.0 <= self.noise < 1.0:
            raise InputError(f"augmentation.noise must be in [0, 1), got {self.noise}")


def augment(
    images: np.ndarray, mask: np.ndarray, config: Augmentation, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return augmented images (Q, H, W, 3) float32 and their light intensities (Q,) float32.

    The images are not multiplied by the mask: the background is noise, as in the authors' training.

    Args:
        images: (Q, H, W, 3) float32 radiance under lights of equal intensity.
        mask: (H, W) bool, the object; used to measure exposure.
        rng: Draws exposure, intensities and noise, in this order; camera and its noise come from a child of it, so that
            they change no other draw.
    """
    bounds = config.exposure_range if config.exposure == "paper" else config.mean_jitter
    factor = np.float32(rng.uniform(*bounds))
    intensities = rng.uniform(*config.intensity_range, len(images)).astype(np.float32)  # (Q,)
    strengths = intensities[:, None, None, None]
    # One copy, then in place: fresh memory for every step would cost more than the arithmetic.
    if config.exposure == "paper":
        images = np.minimum(images, np.float32(config.clip)) if config.sensor is None else _record(images, config, rng)
        images *= factor * strengths
    else:
        images = images * strengths
        if config.sensor is not None:
            images *= exposure_scale(images[:, mask], config.mean_level, config.clip)
            images = _record(images, config, rng)
        images *= factor * exposure_scale(images[:, mask], config.mean_level, config.clip)
        np.minimum(images, np.float32(config.clip), out=images)
    if config.noise:
        noise = rng.random(images.shape, dtype=np.float32)
        noise -= np.float32(0.5)
        noise *= np.float32(config.noise)
        images += noise
    return images, intensities


def _record(images: np.ndarray, config: Augmentation, rng: np.random.Generator) -> np.ndarray:
    """Return images (Q, H, W, 3), float32, as a camera that saturates at `clip` records them."""
    assert config.sensor is not None
    own = rng.spawn(1)[0]
    clip = np.float32(config.clip)
    return config.sensor.draw(own).record(images / clip, own) * clip


def exposure_scale(values: np.ndarray, level: float, clip: float) -> np.float32:
    """Return the factor s for which the mean of min(s * values, clip) is `level`, or 1 for all-black values.

    A few highlights of a mirror can hold most of the radiance; measuring the mean after the clip keeps the
    rest of the object visible. The fixed point is reached from below and to within a few per cent in five steps.
    """
    mean = float(values.mean()) if values.size else 0.0
    if mean <= 0.0:
        return np.float32(1.0)
    scale = level / mean
    for _ in range(5):
        clipped = float(np.minimum(values * np.float32(scale), np.float32(clip)).mean())
        if clipped > 0.99 * level:
            break
        scale *= level / clipped
    return np.float32(scale)


class Exposure(NamedTuple):
    """What brings test images to the exposure of training."""

    scale: float  # multiplies the images
    clip: float  # where they saturate afterwards

    def apply(self, images: np.ndarray) -> np.ndarray:
        """Return exposed images, float32, of images of any shape."""
        return np.minimum(images * np.float32(self.scale), np.float32(self.clip))


def measure_exposure(values: np.ndarray, config: Augmentation) -> Exposure:
    """Return the exposure of test images.

    Args:
        values: Radiance inside the mask, of all images and channels or a fair sample of them; any shape and scale.
        config: The augmentation the network was trained with.
    """
    if config.exposure == "mean":
        return Exposure(float(exposure_scale(values, config.mean_level, config.clip)), config.clip)
    mean = float(values.mean()) if values.size else 0.0
    lift = PAPER_TEST_FLOOR / mean if 0.0 < mean < PAPER_TEST_FLOOR else 1.0
    return Exposure(lift * PAPER_TEST_GAIN, PAPER_TEST_CLIP)
