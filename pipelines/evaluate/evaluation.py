"""Methods on objects: one interface and one metric code for every benchmark, each result kept as it is found.

A result is filed under the method (with its weights, settings and arithmetic), the object (with its images) and the
code, so that a stopped evaluation goes on where it was, and what has changed is evaluated again.
"""

import hashlib
import importlib.metadata
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.evaluate.score_cache import ScoreCache
from render.shared.errors import InputError
from render.shared.files import atomic_path, source_digest

if TYPE_CHECKING:
    from sdps.inference.image_source import ImageSource
    from sdps.methods.runner import Runner

_log = logging.getLogger(__name__)
_FORMAT = "evaluation-2"
_LIBRARIES = ("torch", "numpy", "scipy", "opencv-python-headless")


@dataclass(frozen=True, eq=False)
class TestObject:
    """An object with what is known of it.

    Attributes:
        name: Unique within the evaluation, e.g. `bunny-chrome`.
        digest: Of everything the object's results depend on: images, mask, truth.
        load: Reads the images, (L, H, W, 3) linear radiance, as methods are to see them; called when needed only.
        mask: (H, W) bool.
        normals: (H, W, 3) true normals, or None.
        light_directions: (L, 3) true directions, or None.
        intensities: (L,) or (L, 3) true intensities, or None.
    """

    __test__ = False  # nothing for pytest to collect

    name: str
    digest: str
    load: "Callable[[], ImageSource]"
    mask: np.ndarray
    normals: np.ndarray | None = None
    light_directions: np.ndarray | None = None
    intensities: np.ndarray | None = None

    @property
    def true_directions(self) -> np.ndarray:
        """The true directions (L, 3) of an object that has them."""
        assert self.light_directions is not None, self.name
        return self.light_directions


@dataclass(frozen=True, eq=False)
class Result:
    """What a method made of an object.

    Attributes:
        scores: Metrics by name; empty where the method refused.
        seconds: Time it took.
        reason: Why it refused, in one line, or empty.
        light_directions: (L, 3) estimated or given directions; (0, 3) where there are none.
        intensities: (L,) the same for intensities.
        maps: File with the normal map, or None where it was not to be kept.
    """

    scores: dict[str, float]
    seconds: float = 0.0
    reason: str = ""
    light_directions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    intensities: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    maps: Path | None = None

    def normals(self) -> np.ndarray | None:  # (H, W, 3)
        """Return the estimated normals, or None where they were not kept or the method gives none."""
        if self.maps is None or not self.maps.is_file():
            return None
        with np.load(self.maps) as stored:
            return stored["normals"].astype(np.float32)


class Evaluation:
    """Runs methods on objects and remembers.

    Args:
        folder: Where results are kept: `scores.jsonl`, and normal maps under `maps`.

    Raises:
        InputError: the folder cannot be read or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._cache = ScoreCache(folder / "scores.jsonl", code_identity())

    def result(self, item: TestObject, runner: "Runner", *, keep_normals: bool = False) -> Result:
        """Return what the method makes of the object, from the cache or by running it.

        Args:
            item: The object.
            runner: The method.
            keep_normals: Also keep the normal map (float16).
        """
        return self.results(item, [runner], [keep_normals])[0]

    def results(self, item: TestObject, runners: "Sequence[Runner]", keep_normals: Sequence[bool]) -> list[Result]:
        """Return what several methods make of an object.

        Its images are read once, and only if they are needed; lights that several methods see alike are estimated once.
        """
        images: ImageSource | None = None
        lights: dict[Any, Any] = {}
        found = []
        for runner, keep in zip(runners, keep_normals, strict=True):
            key = (runner.method.name, runner.identity(), item.name, item.digest)
            maps = self._maps(key)
            known = self._cache.get(key)
            if known is None or (keep and known["normals"] and not maps.is_file()):
                images = item.load() if images is None else images
                known = self._run(item, images, runner, maps if keep else None, lights)
                self._cache.add(key, known)
            found.append(_result(known, maps))
        return found

    def _maps(self, key: tuple[str, ...]) -> Path:
        return self.folder / "maps" / f"{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}.npz"

    def _run(
        self, item: TestObject, images: "ImageSource", runner: "Runner", maps: Path | None, lights: dict[Any, Any]
    ) -> dict[str, Any]:
        """Run a method and return what is kept of it, JSON ready."""
        try:
            estimate = runner.estimate(images, item.mask, item.light_directions, item.intensities, lights)
        except InputError as error:  # such as least squares under lights that were all estimated alike
            _log.warning("%s, %s: no score (%s)", item.name, runner.method.name, error)
            return {"scores": {}, "reason": str(error), "seconds": 0.0, "normals": False, "lights": [], "gains": []}
        scores = runner.score(estimate, item.mask, item.normals, item.light_directions, item.intensities)
        if maps is not None and estimate.normals.size:
            with atomic_path(maps) as temporary, temporary.open("wb") as handle:
                np.savez_compressed(handle, normals=estimate.normals.astype(np.float16))
        return {
            "scores": scores,
            "reason": "",
            "seconds": float(estimate.diagnostics.get("seconds", 0.0)),
            "normals": bool(estimate.normals.size),
            "lights": np.round(np.asarray(estimate.light_directions, np.float64), 6).tolist(),
            "gains": np.round(np.asarray(estimate.intensities, np.float64), 6).tolist(),
        }


@cache
def code_identity() -> str:
    """Return what tells results of this code and its libraries from others: any file of the project may matter."""
    root = Path(__file__).parents[2]
    code = source_digest(*(root / package for package in ("render", "sdps", "pipelines")))
    return " ".join([_FORMAT, code, *(f"{name}-{importlib.metadata.version(name)}" for name in _LIBRARIES)])


def _result(known: dict[str, Any], maps: Path) -> Result:
    lights = np.array(known["lights"], np.float32).reshape(-1, 3)
    gains = np.array(known["gains"], np.float32)
    kept = maps if known["normals"] and maps.is_file() else None
    return Result(known["scores"], known["seconds"], known["reason"], lights, gains, kept)
