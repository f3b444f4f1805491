"""Images under environments, areas and several lights at once, mixed from images under single lights.

Light adds up: the image of an object under a radiance E from all directions is the integral of E times its image under
one light of unit irradiance per solid angle (Debevec et al., SIGGRAPH 2000). A dense set of lights turns
the integral into a sum over the lights' cells of the hemisphere, a cell being the directions nearest to a light. Our
images I_i have irradiance pi, so

    image = sum_i I_i w_i,    w_i = 1/pi integral over cell i of E(direction) d(direction).

White Lambertian facing the camera under radiance 1 from the whole hemisphere is then 1: its irradiance is pi.

What is lost. Light from behind the object's plane (z < 0) is not in the images, and such a part of a map is left out.
Light smaller than a cell, about sqrt(2 pi / L) across (9 degrees for 256 lights), comes from the cell's light, so
shadows and highlights are as if a lamp stood at each light. Lamps are distant: their direction is the same everywhere.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.imaging import environments
from render.shared.imaging.vectors import spiral, unit

FEWEST = 128
WIDEST_GAP = 20.0  # degrees from any direction above the horizon to the nearest light
_DENSE = 8192
_REMEDY = f"render a light stage: data.lights=stage data.light_count=256 (at least {FEWEST})"
KINDS = ("environment", "directional", "lamp", "area")


@dataclass(frozen=True, kw_only=True)
class LightMix:
    """Which light an image has: a random choice of four kinds, each with a random share of the light.

    Attributes:
        environments: Maps to draw from: constant, gradient, sky-sun, studio, room, each time with another seed where
            none is given (sky-sun:7); .hdr and .exr files.
        turn: Maps from files are turned about the vertical axis by up to so many degrees, either way.
        environment: Share of the images that have light of a map.
        directional: Share with one distant light.
        lamp: Share with a point-like lamp, a disc of 2 to 10 degrees radius.
        area: Share with an area light, a disc of 10 to 40 degrees radius.
    """

    environments: tuple[str, ...] = ("sky-sun", "studio", "room", "gradient")
    turn: float = 180.0
    environment: float = 0.6
    directional: float = 0.5
    lamp: float = 0.3
    area: float = 0.3

    def __post_init__(self) -> None:
        check_fields(self, "not negative", "turn", *KINDS)
        for name in KINDS:
            if getattr(self, name) > 1.0:
                raise InputError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if not any(getattr(self, name) for name in KINDS):
            raise InputError(f"no light: raise one of {', '.join(KINDS)} above 0")
        if self.environment and not self.environments:
            raise InputError("environments must name a map, or environment be 0")
        for name in self.environments:
            environments.require_name(name)

    def load(self) -> None:
        """Read the maps, so that a file that is none is refused before the work starts.

        Raises:
            InputError: a file that is missing or no map.
        """
        for name in self.environments:
            _map(name)

    def draw(
        self, stage: "LightStage", count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Draw the light of `count` images.

        Returns:
            Weights (count, L, 3) float32 of the stage's images, whose mean over channels sums to 1 for each image, and
            what each image's light is made of: plain values.
        """
        weights, recipes = np.zeros((count, len(stage.directions), 3), np.float32), []
        chances = np.array([getattr(self, name) for name in KINDS])
        for weight in weights:
            there = rng.random(len(KINDS)) < chances
            if not there.any():
                there[rng.choice(len(KINDS), p=chances / chances.sum())] = True
            shares = there * rng.uniform(0.2, 1.0, len(KINDS))
            recipe = []
            for kind, share in zip(KINDS, shares / shares.sum(), strict=True):
                if share:
                    light, about = self.draw_part(kind, stage, rng)
                    weight += (share * light / light.mean(1).sum()).astype(np.float32)
                    recipe.append({"kind": kind, "share": round(float(share), 4), **about})
            recipes.append({"lights": recipe})
        return weights, recipes

    def draw_part(self, kind: str, stage: "LightStage", rng: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a light of a kind: weights (L, 3) of any scale, and what it is."""
        if kind == "environment":
            name = self.environments[int(rng.integers(len(self.environments)))]
            seed, degrees = int(rng.integers(1000)), float(rng.uniform(-self.turn, self.turn))
            if environments.is_file(name):
                return stage.under(environments.turn(_map(name), degrees)), {"map": name, "turn": round(degrees, 2)}
            name = name if ":" in name else f"{name}:{seed}"
            return stage.under(_map(name)), {"map": name}
        direction = np.array([*rng.normal(size=2), abs(rng.normal())])  # uniform over the hemisphere
        direction /= max(float(np.linalg.norm(direction)), 1e-9)
        radius = {"directional": 0.0, "lamp": float(rng.uniform(2, 10)), "area": float(rng.uniform(10, 40))}[kind]
        colour = 1.0 - rng.uniform(0.0, 0.3, 3)
        about = {
            "direction": direction.round(4).tolist(),
            "radius": round(radius, 2),
            "colour": colour.round(3).tolist(),
        }
        return stage.disc(direction, radius)[:, None] * colour, about


class LightStage:
    """The lights of a scene, dense enough that their images add up to any light from above the horizon.

    `gap` is the angle in degrees from any direction above the horizon to the nearest light, at most.

    Args:
        lights: (L, 3) unit vectors to the lights, z > 0.
        where: What they belong to, for messages.
        sparse: Take any lights, each for all directions nearest to it.

    Raises:
        InputError: too few lights, or a part of the hemisphere without any.
    """

    def __init__(self, lights: np.ndarray, where: str, *, sparse: bool = False) -> None:
        self.directions = np.asarray(lights, np.float64).reshape(-1, 3)
        if not sparse:
            require_enough(len(self.directions), where)
        self._tree = cKDTree(self.directions)
        self._owner = self.nearest(_hemisphere())
        self._owners: dict[int, np.ndarray] = {}  # by a map's height: the light nearest to each of its pixels
        cosine = (_hemisphere() * self.directions[self._owner]).sum(1)
        self.gap = gap = float(np.degrees(np.arccos(np.clip(cosine.min(), -1.0, 1.0))))
        if gap > WIDEST_GAP and not sparse:
            raise InputError(
                f"{where}: its lights leave a gap: up to {gap:.0f} degrees to the nearest one, {WIDEST_GAP:g} at most "
                f"can be mixed; {_REMEDY}"
            )

    def nearest(self, vectors: np.ndarray) -> np.ndarray:  # (P,) int
        """Return the number of the light nearest to each direction (P, 3)."""
        return np.asarray(self._tree.query(vectors)[1])

    def under(self, radiance: np.ndarray) -> np.ndarray:  # (L, 3) float64
        """Return the weights of the images under a map (H, 2H, 3); its lower half space (z < 0) is left out."""
        height = len(radiance)
        above, vectors, steradians = _upper(height)
        if height not in self._owners:
            self._owners[height] = self.nearest(vectors)
        owner = self._owners[height]
        power = radiance[above] * (steradians / np.pi)[:, None]  # (P, 3)
        return np.stack([np.bincount(owner, power[:, k], len(self.directions)) for k in range(3)], axis=1)

    def disc(self, direction: np.ndarray, degrees: float) -> np.ndarray:  # (L,) float64, sum 1
        """Return the weights of the images under a disc of even radiance, the part of it above the horizon.

        A disc smaller than a cell is the light nearest to its centre.
        """
        inside = _hemisphere() @ direction > np.cos(np.radians(degrees))
        if not degrees or not inside.any():
            return np.bincount(self.nearest(direction[None]), minlength=len(self.directions)).astype(np.float64)
        counts = np.bincount(self._owner[inside], minlength=len(self.directions))
        return counts / counts.sum()

    def mean_directions(self, weights: np.ndarray) -> np.ndarray:  # (Q, 3) float32
        """Return the unit vector along which the light of each image (Q, L, 3) comes on average."""
        vectors = weights.mean(-1) @ self.directions
        return unit(vectors).astype(np.float32)


def require_enough(count: int, where: str) -> None:
    """Refuse to mix light from fewer than `FEWEST` lights.

    Raises:
        InputError: with the number that is needed.
    """
    if count < FEWEST:
        raise InputError(f"{where}: {count} lights are too few to mix light from, {FEWEST} are needed; {_REMEDY}")


def mix(images: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return mixed images (Q, P, 3) float32.

    Args:
        images: (L, P, 3), pixels of the images under single lights, float16 or float32; may be a memory map.
        weights: (Q, L, 3).

    Pixels that are black under all lights, as the background is, cost next to nothing.
    """
    mixed = np.zeros((len(weights), images.shape[1], 3), np.float32)
    bits = np.ascontiguousarray(images).view(f"u{images.itemsize}")
    lit = np.flatnonzero(np.bitwise_or.reduce(bits.reshape(len(images), -1)).reshape(-1, 3).any(1))
    images = images if len(lit) == images.shape[1] else images.take(lit, axis=1)
    for channel in range(3):  # one at a time: a third of the memory; contiguous: the same sums however images lie
        single = np.ascontiguousarray(images[..., channel], np.float32)
        mixed[:, lit, channel] = np.ascontiguousarray(weights[..., channel], np.float32) @ single
    return mixed


def share_behind(radiance: np.ndarray) -> float:
    """Return the share of a map's light that comes from behind the object's plane (z < 0), and is lost."""
    power = radiance.mean(-1) * environments.solid_angles(len(radiance))
    return float(power[environments.directions(len(radiance))[..., 2] <= 0].sum() / power.sum())


@lru_cache(maxsize=64)
def _map(name: str) -> np.ndarray:
    return environments.load(name)


@lru_cache(maxsize=4)
def _upper(height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which pixels of a map are above the horizon (H, 2H), their directions (P, 3) and steradians (P,)."""
    vectors = environments.directions(height)
    above = vectors[..., 2] > 1e-9
    return above, vectors[above], np.broadcast_to(environments.solid_angles(height), above.shape)[above]


@lru_cache(maxsize=1)
def _hemisphere() -> np.ndarray:  # (_DENSE, 3)
    """Return directions evenly spread over the upper hemisphere."""
    return spiral(_DENSE, lowest=0.0)
