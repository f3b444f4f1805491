"""Numbers that describe one shard: mask area, exposure, slant of the normals."""

from dataclasses import dataclass

import numpy as np

from render.records.shards import Shard


@dataclass(frozen=True)
class SceneStatistics:
    """Measures of one scene.

    Attributes:
        area: Share of the frame the mask covers.
        level: 95th percentile of the object's radiance over all lights, per colour channel pooled.
        peak: Largest radiance.
        lit: Share of the object's values above zero.
        slant: Mean angle between normals and the viewing axis, degrees.
        bytes: Size of the file, 0 when unknown.
    """

    area: float
    level: float
    peak: float
    lit: float
    slant: float
    bytes: int = 0


def measure(shard: Shard, size: int = 0) -> SceneStatistics:
    """Measure a shard whose values are finite; an empty mask gives zeros."""
    if not shard.mask.any():
        return SceneStatistics(0.0, 0.0, 0.0, 0.0, 0.0, size)
    values = shard.images[:, shard.mask].astype(np.float32)
    return SceneStatistics(
        area=float(shard.mask.mean()),
        level=float(np.percentile(values, 95)),
        peak=float(values.max()),
        lit=float((values > 0).mean()),
        slant=float(slants(shard).mean()),
        bytes=size,
    )


def slants(shard: Shard) -> np.ndarray:  # (P,)
    """Return the angle of each normal in the mask to the viewing axis, degrees."""
    return np.degrees(np.arccos(np.clip(shard.normals[shard.mask][:, 2], -1.0, 1.0)))


def summarise(values: list[float]) -> dict[str, float]:
    """Return minimum, median, mean and maximum, and the 5th and 95th percentiles."""
    array = np.asarray(values, np.float64)
    low, median, high = np.percentile(array, [5, 50, 95])
    numbers = {"min": array.min(), "p5": low, "median": median, "mean": array.mean(), "p95": high, "max": array.max()}
    return {name: float(f"{value:.5g}") for name, value in numbers.items()}
