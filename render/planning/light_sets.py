"""Sets of directional lights over the upper hemisphere, by name, from a file or drawn from a distribution.

A set is an (L, 3) float64 array of unit vectors from the surface to the light, camera frame (x right, y up,
z to the camera), every z > 0.
"""

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from render.planning import arrangements
from render.shared.config import read_yaml
from render.shared.errors import InputError, unknown
from render.shared.files import read_text
from render.shared.seeds import generator
from render.shared.tables import number_lines

MAX_ANGLE = 88.0  # degrees; beyond it the image is black but for rim pixels
BIASED_MIN_Y = -0.1


def azimuth_elevation(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw lights with azimuth and elevation each uniform in (-88, 88) degrees, as the published training sets.

    Azimuth turns around the vertical y axis, elevation rises towards +y (SDPS-Net's angles, `sdps.core.lighting`).
    """
    azimuth, elevation = np.radians(rng.uniform(-MAX_ANGLE, MAX_ANGLE, (2, count)))
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=1
    )


def hemisphere(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw lights uniform in solid angle over the cap of 88 degrees around the viewing axis."""
    z = rng.uniform(np.cos(np.radians(MAX_ANGLE)), 1.0, count)
    return _around_axis(z, rng)


def near_uniform(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw lights uniform over the unit disc of (x, y), so denser towards the camera (the paper's "near uniform")."""
    radius = np.sqrt(rng.uniform(0.0, np.sin(np.radians(MAX_ANGLE)) ** 2, count))
    return _around_axis(np.sqrt(1.0 - radius**2), rng)


def biased(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw lights uniform over the upper part of the disc, y > -0.1 (the paper's "biased")."""
    kept = np.zeros((0, 3))
    while len(kept) < count:
        drawn = near_uniform(2 * count, rng)
        kept = np.concatenate([kept, drawn[drawn[:, 1] > BIASED_MIN_Y]])
    return kept[:count]


def _around_axis(z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Turn each height z into a unit vector at a uniform angle around the viewing axis."""
    angle = rng.uniform(0.0, 2.0 * np.pi, len(z))
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def mixed(count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw one of the distributions by the shares of `MIXED`, then the lights from it."""
    name = str(rng.choice(list(MIXED), p=list(MIXED.values())))
    return DISTRIBUTIONS[name](count, rng)


MIXED = {
    "grid": 0.35, "azimuth-elevation": 0.2, "near-uniform": 0.15, "rings": 0.1, "dome": 0.1, "hand-held": 0.1,
}  # fmt: skip
"""Shares of `mixed`: a third are narrow grids before the object, as those of DiLiGenT."""
DISTRIBUTIONS = {
    "azimuth-elevation": azimuth_elevation,
    "hemisphere": hemisphere,
    "near-uniform": near_uniform,
    "biased": biased,
    "grid": arrangements.grid,
    "rings": arrangements.rings,
    "dome": arrangements.dome,
    "hand-held": arrangements.hand_held,
    "stage": arrangements.stage,
    "mixed": mixed,
}


def names() -> list[str]:
    """Return the names of the fixed light sets that travel with the package."""
    folder = resources.files("assets") / "lights"
    return sorted(item.name[:-5] for item in folder.iterdir() if item.name.endswith(".yaml"))


def draw(name: str, count: int, rng: np.random.Generator) -> np.ndarray:  # (count, 3)
    """Draw `count` lights from the distribution `name`.

    Raises:
        InputError: unknown distribution.
    """
    if name not in DISTRIBUTIONS:
        raise unknown("light distribution", name, DISTRIBUTIONS)
    return DISTRIBUTIONS[name](count, rng)


def load(name: str) -> np.ndarray:  # (L, 3)
    """Read a fixed set by name (`merltest`), draw one (`biased:64`), or read a user's list of directions.

    A drawn set is the same every time, for its name and count. A user's list is a YAML file with `directions`, or a
    text file with three numbers a line; vectors are brought to unit length.

    Raises:
        InputError: unknown name, malformed file, no light, or a light below the horizon (named by its line).
    """
    if name in names():
        return check(read_yaml(str(resources.files("assets") / "lights" / f"{name}.yaml")).get("directions"), name)
    distribution, colon, count = name.partition(":")
    if colon and distribution in DISTRIBUTIONS:
        if not (count.isascii() and count.isdecimal() and int(count) > 0):
            raise InputError(f"light set {name!r}: expected a number of lights after the colon, as in 'biased:64'")
        return draw(distribution, int(count), generator(0, "light set", distribution, int(count)))
    path = Path(name)
    if not path.suffix and not path.exists():
        known = [*names(), *(f"{name}:64" for name in DISTRIBUTIONS)]
        raise unknown("light set", name, known, "or give a file of directions")
    if path.suffix in (".yaml", ".yml"):
        return check(read_yaml(path).get("directions"), name)
    lines = [(number, line.partition("#")[0].strip()) for number, line in number_lines(read_text(path))]
    lines = [(number, line) for number, line in lines if line]
    return check([line.replace(",", " ").split() for _, line in lines], name, [number for number, _ in lines])


def check(rows: object, name: str, lines: Sequence[int] = ()) -> np.ndarray:  # (L, 3)
    """Return rows of three numbers as unit vectors.

    Args:
        rows: What was read.
        name: The file, for messages.
        lines: The rows' lines in a text.

    Raises:
        InputError: not a list, an empty list, or a row that is not a light above the horizon (named by its number).
    """
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{name}: directions: expected a list of [x, y, z] rows")
    vectors = []
    for number, row in enumerate(rows, start=1):
        where = f" (line {lines[number - 1]})" if lines else ""
        try:
            vector = np.array([float(value) for value in row])
        except (TypeError, ValueError):
            vector = np.zeros(0)
        if vector.shape != (3,) or not np.isfinite(vector).all() or not np.linalg.norm(vector) > 0:
            raise InputError(f"{name}: light {number}: expected three numbers x y z, got {row}{where}")
        if vector[2] <= 0:
            raise InputError(
                f"{name}: light {number} is below the horizon (z = {vector[2]:g}); z must be above 0{where}"
            )
        vectors.append(vector / np.linalg.norm(vector))
    return np.stack(vectors)
