"""The settings of a training run: one frozen dataclass per kind of model, defaults as in the paper's code.

A run ends after `epochs`, or after `steps` or `minutes` when one of these is given; the learning rate
follows the share of that budget already spent, so a shorter budget anneals fully all the same.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from render.shared.config import check_fields
from render.shared.errors import InputError
from sdps.core.lighting import LightClasses, ReadOut
from sdps.core.precision import Precision
from sdps.data.augment import Augmentation
from sdps.models.lcnet import EARLY_SIZE, INPUT_SIZE

Schedule = Literal["halving", "cosine", "constant", "warmup-stable-decay", "trapezoid"]
EARLIER_NAMES = {"trapezoid": "warmup-stable-decay"}
"""What presets, checkpoints and cards of earlier versions call a schedule."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """What all kinds of models share.

    Attributes:
        seed: Root seed of weights, order, image subsets and augmentation.
        start: Weights of the same network that training starts from: a run, `shipped:<name>` or a `.safetensors` file;
            empty for random weights.
        start_share: Share of the start in the weights that are validated and saved; the rest is what was trained (0:
            all of it). Averages of fine-tuned weights and those before them are often better than both (Wortsman et
            al., Robust fine-tuning of zero-shot models, CVPR 2022, eq. 1, whose alpha is 1 less this).
        epochs: Passes over the training scenes, unless `steps` or `minutes` is set.
        steps: Optimiser steps to take instead.
        minutes: Minutes of training to spend instead, counted across resumed runs.
        batch_scenes: Scenes per optimiser step.
        accumulate: Parts a step's scenes are processed in, to save memory; must divide `batch_scenes`.
        images: Images drawn per scene and step.
        fewest_images: Where samples are made on the device (`resident`) or their light is mixed, each step draws so
            many to `images`; 0: always `images`.
        size: Side in pixels to which scenes of another size are resized.
        learning_rate: Peak learning rate.
        schedule: `halving` (after each of `halve_after`), `cosine` (to zero), `constant`, or
            `warmup-stable-decay`: constant until the last share `cooldown` of the budget, then linearly to zero; the
            budget may be raised until then.
        cooldown: See `schedule`.
        halve_after: Epochs after which `halving` halves; scaled with the budget when it is not `epochs`.
        warmup: Share of the budget over which the learning rate rises linearly from zero.
        optimiser: `adam` or `adamw`, betas 0.9 and 0.999; or `muon` (`sdps.training.muon`), with AdamW for what is not
            a matrix.
        weight_decay: Weight decay (0 in the paper: its 4e-4 is parsed but never used).
        clip_gradient: Largest gradient norm; 0 leaves gradients alone.
        ema: Decay of an exponential moving average of the weights, which is then validated and saved (0: none).
        compile: Compile the network with `torch.compile`.
        precision: `auto` (what is faster on this machine, `sdps.core.precision`), `float32`, or `bfloat16`, which
            runs the networks under autocast; weights and loss stay float32.
        channels_last: Keep feature maps channels-last, faster on every processor tried (docs/studies/speed.md).
        workers: Loader processes; 0 loads in the trainer's own.
        cache: Keep decoded scenes as memory-mapped arrays in `<data>/cache`.
        shuffle_window: Of a packed set (`sdps data pack`), scenes among which the order is drawn; only about twice as
            many are kept on this disk. With more than there are, the order is that of a data folder.
        resident: Hold the scenes in the GPU's memory and make samples there (`sdps.data.resident`); `workers`
            processes decode them. With `skip_missing`, scenes that are rendered meanwhile are taken in, too.
        rescale: Scenes larger than `size` are drawn at a random scale and cropped, instead of being shrunk whole.
        skip_missing: Train on the scenes that are there instead of refusing an incomplete folder.
        log_every: Steps between lines of metrics.
        validate_every: Steps between validations; 0 validates at the end only.
        validation_scenes: Scenes of split `val` to validate on (0: none).
        validation_images: Images drawn per validation scene; as in training where it is not set. In use there are more,
            and what is better with few need not be with many.
        checkpoint_minutes: Minutes between checkpoints.
        augmentation: How images are altered.
    """

    seed: int = 0
    start: str = ""
    start_share: float = 0.0
    epochs: float = 20.0
    steps: int | None = None
    minutes: float | None = None
    batch_scenes: int = 32
    accumulate: int = 1
    images: int = 32
    fewest_images: int = 0
    size: int = 128
    learning_rate: float = 5e-4
    schedule: Schedule = "halving"
    halve_after: tuple[float, ...] = (5.0, 10.0, 15.0)
    cooldown: float = 0.2
    warmup: float = 0.0
    optimiser: Literal["adam", "adamw", "muon"] = "adam"
    weight_decay: float = 0.0
    clip_gradient: float = 0.0
    ema: float = 0.0
    compile: bool = False
    precision: Precision = "auto"
    channels_last: bool = True
    workers: int = 2
    cache: bool = True
    shuffle_window: int = 1024
    resident: bool = False
    rescale: bool = False
    skip_missing: bool = False
    log_every: int = 20
    validate_every: int = 0
    validation_scenes: int = 16
    validation_images: int | None = None
    checkpoint_minutes: float = 5.0
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        object.__setattr__(self, "schedule", EARLIER_NAMES.get(self.schedule, self.schedule))
        for name in ("epochs", "steps", "minutes", "batch_scenes", "accumulate", "images", "validation_images",
                     "learning_rate", "shuffle_window", "log_every", "checkpoint_minutes"):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise InputError(f"{name} must be positive, got {value}")
        check_fields(
            self,
            "not negative",
            "seed",
            "fewest_images",
            "weight_decay",
            "clip_gradient",
            "workers",
            "validate_every",
            "validation_scenes",
        )
        if self.steps is not None and self.minutes is not None:
            raise InputError("steps and minutes are both set; keep one of them")
        if self.batch_scenes % self.accumulate:
            raise InputError(f"accumulate {self.accumulate} must divide batch_scenes {self.batch_scenes}")
        varies = self.resident or self.augmentation.mixed is not None
        if self.fewest_images and not (varies and self.fewest_images <= self.images):
            raise InputError(
                f"fewest_images {self.fewest_images} needs resident: true or augmentation.mixed, and to be at most "
                f"images ({self.images})"
            )
        if self.size < 16 or self.size % 4:
            raise InputError(f"size must be a multiple of 4 and at least 16, got {self.size}")
        if self.start_share and not self.start:
            raise InputError(f"start_share is {self.start_share}, but there is no start; name one, or leave it out")
        for name in ("start_share", "warmup", "ema", "cooldown"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InputError(f"{name} must be in [0, 1), got {getattr(self, name)}")
        if self.schedule == "halving" and any(not 0.0 < epoch < self.epochs for epoch in self.halve_after):
            raise InputError(f"halve_after must lie between 0 and epochs ({self.epochs:g}), got {self.halve_after}")

    def learning_rate_at(self, progress: float) -> float:
        """Return the learning rate when the share `progress` in [0, 1] of the budget is spent."""
        peak = self.learning_rate
        if progress < self.warmup:
            return peak * max(progress / self.warmup, 0.01)
        if self.schedule == "halving":
            return peak * 0.5 ** sum(progress * self.epochs >= epoch - 1e-9 for epoch in self.halve_after)
        if self.schedule == "cosine":
            annealed = (min(progress, 1.0) - self.warmup) / (1.0 - self.warmup)
            return peak * 0.5 * (1.0 + math.cos(math.pi * annealed))
        if self.schedule == "warmup-stable-decay":
            return peak * min(1.0, max(1.0 - progress, 0.0) / max(self.cooldown, 1e-9))
        return peak


@dataclass(frozen=True, kw_only=True)
class LightingTraining(TrainingConfig):
    """Models that find lights.

    Attributes:
        direction_classes: K_d, classes of azimuth and of elevation.
        intensity_classes: K_e.
        options: Options of the network over those of its registry entry, for variants of a model.
    """

    direction_classes: int = 36
    intensity_classes: int = 20
    options: dict[str, bool | int | float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size not in (EARLY_SIZE, INPUT_SIZE):
            raise InputError(
                f"size must be {INPUT_SIZE} for LCNet, whose last layers need it, or {EARLY_SIZE} for a run that "
                f"others start from, got {self.size}"
            )
        low, high = self.intensity_range()
        # Refuses numbers that make no classes.
        LightClasses(directions=self.direction_classes, intensities=self.intensity_classes, low=low, high=high)

    def intensity_range(self) -> tuple[float, float]:
        """Return the range the intensity classes cover: the one intensities are drawn from."""
        low, high = self.augmentation.intensity_range
        return low, max(high, low + 1e-3)


@dataclass(frozen=True, kw_only=True)
class NormalTraining(TrainingConfig):
    """Models that give normals, on the lights of a frozen lighting model, on true lights, or on none.

    Attributes:
        loss: 1 - cos, averaged over the object (`masked`) or over all pixels as the authors' code does (`faithful`); or
            the distance of the unit vectors, averaged over the object (`chord`).
        lights: The run of a lighting model, `shipped:<name>`, a `.safetensors` file, or `true`; empty: what the
            model's registry entry names.
        read_out: How light classes become lights: `centre` (argmax, the paper's), `expectation` (soft-argmax) or
            `peak` (parabolic).
        light_blend: Largest share of the way to the true lights that estimated ones are moved, drawn evenly for each
            training sample; of shares drawn above 1 the lights are the true ones. Many images and test-time
            augmentation give better lights than a sample's few images.
        light_error: Size of the errors drawn onto the lights in training, 1 for those of lights estimated from few
            images. So a network learns what estimated lights are worth, without a lighting model.
        crop: Side of the random crop the network sees (0: the whole image); the lighting model always sees the whole.
        min_object: Least share of object pixels a crop should have; the best of a few draws is taken.
        lighting_weight: Weight of the lighting loss next to the normal loss, for models that learn both.
        gradient_weight: Weight of the error of the normals' steps from pixel to pixel.
        expected_weight: Weight of the errors of the expected error, for models that learn it.
        options: Options of the network over those of its registry entry, for variants of a model.
    """

    epochs: float = 10.0
    batch_scenes: int = 16
    halve_after: tuple[float, ...] = (2.0, 4.0, 6.0, 8.0)
    loss: Literal["masked", "faithful", "chord"] = "masked"
    lights: str = ""
    read_out: ReadOut = "centre"
    light_blend: float = 0.0
    light_error: float = 0.0
    crop: int = 0
    min_object: float = 0.3
    lighting_weight: float = 0.1
    gradient_weight: float = 0.0
    expected_weight: float = 0.02
    options: dict[str, bool | int | float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.crop and (self.crop % 4 or not 16 <= self.crop <= self.size):
            raise InputError(f"crop must be 0 or a multiple of 4 from 16 to size ({self.size}), got {self.crop}")
        if not 0.0 <= self.light_blend <= 10.0:
            raise InputError(f"light_blend must be in [0, 10], got {self.light_blend}")
        if not 0.0 <= self.min_object < 1.0:
            raise InputError(f"min_object must be in [0, 1), got {self.min_object}")
        weights = "lighting_weight", "gradient_weight", "expected_weight"
        check_fields(self, "not negative", "light_error", *weights)


@dataclass(frozen=True, kw_only=True)
class PixelTraining(NormalTraining):
    """Models that see one pixel at a time (CNN-PS).

    Attributes:
        pixels_per_scene: Pixels drawn per scene and step.
        min_lights: Fewest lights a pixel is given.
        rotations: Rotations about the view axis averaged at test.
    """

    epochs: float = 10.0
    batch_scenes: int = 8
    images: int = 64
    learning_rate: float = 1e-3
    schedule: Schedule = "constant"
    halve_after: tuple[float, ...] = ()
    pixels_per_scene: int = 96
    min_lights: int = 8
    rotations: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "at least 1", "pixels_per_scene", "min_lights", "rotations")
