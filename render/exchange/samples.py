"""How a shard becomes pictures: random intensities, exposure, rounding."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from render.exchange.layouts import LAYOUTS
from render.exchange.layouts.layout_base import Sample
from render.records.manifest import SceneSpec
from render.records.shards import Shard
from render.shared.config import check_fields, to_plain
from render.shared.errors import InputError, unknown
from render.shared.images import quantise
from render.shared.imaging import mixing
from render.shared.seeds import generator

INTENSITY_RANGE = (0.2, 2.0)
"""Range of random intensities (SDPS-Net, section 5.1)."""

_AUTO_CLIPPED = {8: 0.01, 16: 0.001}
"""Share of the object's values `auto` lets clip; 16 bits have room below for more highlight."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """How shards become pictures.

    Attributes:
        layout: A name of `LAYOUTS`.
        bits: 8 or 16 per channel; the layout's own by default.
        exposure: Factor on radiance, 1 maps a white Lambertian surface that faces its light to full scale; `auto`
            picks it per scene so that 1 % (8 bits) or 0.1 % (16 bits) of the object's values clip.
        intensities: `unit`, or `seed`: one per image, uniform in [0.2, 2), drawn from the scene's own seed.
        mixed: Light that is mixed from that of the scene (`render.shared.imaging.mixing`); None keeps a light an image.
        images: Images mixed of each scene.
        seed: Root seed of the mixtures.
    """

    layout: str
    bits: int | None = None
    exposure: float | Literal["auto"] | None = None
    intensities: Literal["unit", "seed"] = "unit"
    mixed: mixing.LightMix | None = None
    images: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise unknown("layout", self.layout, LAYOUTS)
        layout = LAYOUTS[self.layout]
        if self.bits is not None and self.bits not in layout.bits:
            allowed = " or ".join(map(str, layout.bits))
            raise InputError(f"bits must be {allowed} for layout {self.layout}, got {self.bits}")
        number = isinstance(self.exposure, int | float) and 0 < self.exposure < float("inf")
        if not number and self.exposure not in ("auto", None):
            raise InputError(f"exposure must be a positive number or 'auto', got {self.exposure!r}")
        if self.intensities not in ("unit", "seed"):
            raise unknown("value for intensities:", str(self.intensities), ("unit", "seed"))
        if self.intensities != "unit" and not layout.intensities:
            raise InputError(f"layout {self.layout} has no file for intensities; leave them at 'unit'")
        if self.mixed is not None and layout.directions:
            others = " or ".join(name for name, other in LAYOUTS.items() if not other.directions)
            raise InputError(f"layout {self.layout} has one direction per image, mixed light has none; take {others}")
        check_fields(self, "at least 1", "images")
        check_fields(self, "not negative", "seed")

    def settings(self) -> dict[str, Any]:
        """Return the options with the layout's defaults filled in."""
        layout = LAYOUTS[self.layout]
        settings: dict[str, Any] = {
            "layout": self.layout,
            "bits": self.bits or layout.bits[0],
            "exposure": layout.exposure if self.exposure is None else self.exposure,
            "intensities": self.intensities,
        }
        if self.mixed is not None:
            settings["mixed"] = to_plain(self.mixed) | {"images": self.images, "seed": self.seed}
        return settings


def prepare(shard: Shard, scene: SceneSpec, options: ExportOptions) -> tuple[Sample, dict[str, Any]]:
    """Apply intensities and exposure and round to integers.

    Returns:
        The sample; its exposure, the share of the object's values that clip, and of its positive ones that round to 0;
        where light is mixed, what each image's light is made of.
    """
    bits, exposure = (options.settings()[name] for name in ("bits", "exposure"))
    radiance, directions, facts = _relight(shard, scene, options)
    count = len(radiance)
    intensities = np.ones(count)
    if options.intensities == "seed":
        intensities = generator(scene.seed, "export", scene.id, "intensities").uniform(*INTENSITY_RANGE, count).round(6)
    values = radiance.astype(np.float32) * intensities[:, None, None, None].astype(np.float32)
    inside = values[:, shard.mask]
    if exposure == "auto":
        level = float(np.quantile(inside, 1.0 - _AUTO_CLIPPED[bits], method="higher")) if inside.size else 0.0
        exposure = float(f"{1.0 / level:.6g}") if level > 0 else 1.0
    step = 0.5 / (2**bits - 1)  # what rounds to full scale, or to the first code, is not lost
    exposed = inside * np.float32(exposure)
    clipped, black = (
        float(lost.mean()) if lost.size else 0.0 for lost in (exposed > 1.0 + step, exposed[inside > 0] < step)
    )
    sample = Sample(quantise(values * np.float32(exposure), bits), shard.normals, shard.mask, directions, intensities)
    return sample, {"exposure": exposure, "clipped": round(clipped, 6), "black": round(black, 6)} | facts


def _relight(shard: Shard, scene: SceneSpec, options: ExportOptions) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Return radiance (Q, H, W, 3), the directions (Q, 3) its light comes from, and what that light is made of."""
    if options.mixed is None:
        return shard.images, np.asarray(scene.lights, np.float64).reshape(-1, 3), {}
    stage = mixing.LightStage(scene.light_directions(), f"scene {scene.id}")
    rng = generator(options.seed, "relight", scene.id)
    weights, recipes = options.mixed.draw(stage, options.images, rng)
    images = mixing.mix(shard.images.reshape(len(shard.images), -1, 3), weights)
    mean = stage.mean_directions(weights).astype(np.float64)
    return images.reshape(-1, *shard.images.shape[1:]), mean, {"lighting": recipes}
