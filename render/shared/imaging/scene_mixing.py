"""Which light the images of a training sample have: one lamp each, surroundings alone, or several lights at once."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.imaging.mixing import LightMix, LightStage

_ROOM = (0.1, 0.7)
"""Share of an image's light, on average, that comes from a room that stays."""
_STRENGTHS = (0.5, 2.0)
"""Of the lamps in a room that stays: there each image has its own share of the room's light."""


@dataclass(frozen=True, kw_only=True)
class SceneMix(LightMix):
    """Light drawn for all images of a sample together; by default as `LightMix` draws it for each.

    Attributes:
        sparse: Mix from any lights, each of which stands for all directions nearest to it, near lamps as they are:
            images under mixtures of them are true ones, though not those of the very environment that was drawn. Else
            scenes must be dense light stages.
        single: Share of the samples whose images have a light of the scene each.
        surrounded: Share of the samples whose images have the light of an environment each, and no other.
        steady: Of all other samples, the share in which the same environment lights every image.
    """

    sparse: bool = False
    single: float = 0.0
    surrounded: float = 0.0
    steady: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "not negative", "single", "surrounded", "steady")
        if self.single + self.surrounded > 1.0 or self.steady > 1.0:
            raise InputError(
                f"single and surrounded must add up to 1 at most, and steady be at most 1, got {self.single}, "
                f"{self.surrounded} and {self.steady}"
            )
        if not self.environments and self.surrounded + self.steady:
            raise InputError("environments must name a map, or surrounded and steady be 0")

    def draw(self, stage: LightStage, count: int, rng: np.random.Generator) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Draw the light of `count` images; returns what `LightMix.draw` does."""
        if not self.single + self.surrounded + self.steady:
            return super().draw(stage, count, rng)
        kind = rng.random()
        if kind < self.single:
            return _draw_single(stage, count, rng)
        plain = LightMix(**{name: getattr(self, name) for name in LightMix.__dataclass_fields__})
        if kind < self.single + self.surrounded:
            return replace(plain, environment=1.0, directional=0.0, lamp=0.0, area=0.0).draw(stage, count, rng)
        if rng.random() >= self.steady:
            return plain.draw(stage, count, rng)
        room, about = plain.draw_part("environment", stage, rng)
        room /= room.mean(1).sum()
        chances = {name: max(getattr(plain, name), 0.05) for name in ("directional", "lamp", "area")}
        weights, recipes = replace(plain, environment=0.0, **chances).draw(stage, count, rng)
        share = rng.uniform(*_ROOM)
        weights = (1.0 - share) * weights * rng.uniform(*_STRENGTHS, (count, 1, 1)) + share * room
        for recipe in recipes:
            recipe["lights"].append({"kind": "environment", "share": round(float(share), 4), **about})
        weights /= weights.mean(2).sum(1)[:, None, None]
        return weights.astype(np.float32), recipes


def _draw_single(stage: LightStage, count: int, rng: np.random.Generator) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Return weights (count, L, 3) of images that have a light of the scene each, all of them before any twice."""
    lights = len(stage.directions)
    chosen = np.concatenate([rng.permutation(lights) for _ in range(-(-count // lights))])[:count]
    weights = np.zeros((count, lights, 3), np.float32)
    weights[np.arange(count), chosen] = 1.0
    directions = stage.directions[chosen].round(4).tolist()
    return weights, [{"lights": [{"kind": "single", "share": 1.0, "direction": each}]} for each in directions]
