"""Run methods on objects, with one interface and one set of metrics for every benchmark, and keep each result.

A result is filed under the method (with its weights, settings and arithmetic), the object (with its images) and the
code, so that an evaluation that was stopped continues where it was, and what has changed is evaluated again.
"""

import hashlib
import importlib.metadata
import json
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from render.shared.errors import InputError
from render.shared.files import atomic_path, read_whole_lines, source_digest
from render.shared.progress import progress_bar
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Rig

if TYPE_CHECKING:
    from sdps.inference.image_source import ImageSource
    from sdps.methods.runner import Found as FoundLights
    from sdps.methods.runner import Runner

K = TypeVar("K")
_log = logging.getLogger(__name__)
_FORMAT = "evaluation-3"
_NOTES = ("gbr", "candidates", "intersections")
_LIBRARIES = ("torch", "numpy", "scipy", "opencv-python-headless")


@dataclass(frozen=True, eq=False)
class TestObject:
    """An object and what is known about it.

    Attributes:
        name: Unique within the evaluation, e.g. `bunny-chrome`.
        digest: Of everything the object's results depend on: images, mask, truth.
        load: Reads the images, (L, H, W, 3) linear radiance, as methods are to see them; called when needed only.
        mask: (H, W) bool.
        normals: (H, W, 3) true normals, or None.
        light_directions: (L, 3) true directions, or None.
        intensities: (L,) or (L, 3) true intensities, or None.
        pictured: Whether its normal maps may be kept.
        camera: What the images were taken with.
    """

    __test__ = False  # nothing for pytest to collect

    name: str
    digest: str
    load: "Callable[[], ImageSource]"
    mask: np.ndarray
    normals: np.ndarray | None = None
    light_directions: np.ndarray | None = None
    intensities: np.ndarray | None = None
    pictured: bool = True
    camera: Camera | None = None

    @property
    def true_directions(self) -> np.ndarray:
        """The true directions (L, 3) of an object that has them."""
        assert self.light_directions is not None, self.name
        return self.light_directions


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a method on an object.

    Attributes:
        scores: Metrics by name; empty where the method refused.
        seconds: Time it took.
        reason: Why it refused, in one line, or empty.
        light_directions: (L, 3) estimated or given directions; (0, 3) where there are none.
        intensities: (L,) the same for intensities.
        maps: File with the normal map, or None where it was not kept.
        notes: What else a classical method reports: the transformation it found, and what it found it from.
    """

    scores: dict[str, float]
    seconds: float = 0.0
    reason: str = ""
    light_directions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    intensities: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    maps: Path | None = None
    notes: dict[str, Any] = field(default_factory=dict)

    def normals(self) -> np.ndarray | None:  # (H, W, 3)
        """Return the estimated normals, or None where they were not kept or the method gives none."""
        if self.maps is None or not self.maps.is_file():
            return None
        with np.load(self.maps) as stored:
            return stored["normals"].astype(np.float32)


Found = dict[str, dict[str, Result]]
"""Results by method, then object."""


class ScoreCache:
    """Results by key in a file of JSON lines, appended to one by one.

    A line torn by a crash is skipped, and its result found again.

    Args:
        path: The file; it appears with its first line.
        identity: What the results depend on besides their key. Lines written under another identity are ignored.

    Raises:
        InputError: the file cannot be read or written.
    """

    def __init__(self, path: Path, identity: str) -> None:
        self.path, self.identity = path, identity
        self._found: dict[tuple[str, ...], Any] = {}
        for row in read_whole_lines(path):
            if isinstance(row, dict) and row.get("identity") == identity and {"key", "value"} <= row.keys():
                self._found[tuple(row["key"])] = row["value"]

    def get(self, key: tuple[str, ...]) -> Any:
        """Return the result of a key, or None."""
        return self._found.get(key)

    def add(self, key: tuple[str, ...], value: Any) -> None:
        """Keep a result, in memory and at the end of the file."""
        self._found[key] = value
        row = {"identity": self.identity, "key": list(key), "value": value}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as handle:
                handle.write(f"\n{json.dumps(row)}\n")  # the file may end in a torn line
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror or error})") from error


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

    def results(self, item: TestObject, runners: "Sequence[Runner]", keep: Collection[str] = ()) -> list[Result]:
        """Return the results of methods on an object, from the cache or by running them.

        Its images are read once, and only if needed; lights that several methods would estimate alike are estimated
        once.

        Args:
            item: The object.
            runners: The methods.
            keep: Names of methods whose normal maps are kept (float16).
        """
        images, found = None, []
        lights: FoundLights = {}
        for runner in runners:
            key = (runner.method.name, runner.identity(), item.name, item.digest)
            kept, maps = item.pictured and runner.method.name in keep, self._maps(key)
            known = self._cache.get(key)
            if known is None or (kept and known["normals"] and not maps.is_file()):
                images = item.load() if images is None else images
                known = self._run(item, images, runner, maps if kept else None, lights)
                self._cache.add(key, known)
            found.append(_result(known, maps))
        return found

    def run(
        self,
        objects: Iterable[tuple[K, TestObject]],
        runners: "Sequence[Runner]",
        total: int,
        about: str,
        keep: Collection[str] = (),
    ) -> "Iterator[tuple[K, Runner, Result]]":
        """Run methods on objects with a progress bar, or take their results from the cache.

        Args:
            objects: Keys of the caller, each with an object.
            runners: The methods.
            total: Number of objects.
            about: What the progress bar says.
            keep: Names of methods whose normal maps are kept, of the objects that are `pictured`.

        Yields:
            The key, the method and its result, object by object.
        """
        with progress_bar(total=total * len(runners), desc=about, unit="map") as bar:
            for key, item in objects:
                for runner, result in zip(runners, self.results(item, runners, keep), strict=True):
                    yield key, runner, result
                    bar.update()

    def _maps(self, key: tuple[str, ...]) -> Path:
        return self.folder / "maps" / f"{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}.npz"

    def _run(
        self, item: TestObject, images: "ImageSource", runner: "Runner", maps: Path | None, lights: "FoundLights"
    ) -> dict[str, Any]:
        """Run a method and return the part of its result that is kept, JSON ready."""
        try:
            rig = Rig(item.camera or ORTHOGRAPHIC)
            estimate = runner.estimate(images, item.mask, item.light_directions, item.intensities, lights, rig=rig)
        except InputError as error:  # such as least squares under lights that were all estimated alike
            _log.warning("%s, %s: no score (%s)", item.name, runner.method.name, error)
            return {"scores": {}, "reason": str(error), "seconds": 0.0, "normals": False, "lights": [], "gains": [],
                    "notes": {}}  # fmt: skip
        scores = runner.score(estimate, item.mask, item.normals, item.light_directions, item.intensities)
        if maps is not None and estimate.normals.size:
            with atomic_path(maps) as temporary, temporary.open("wb") as handle:
                np.savez_compressed(handle, normals=estimate.normals.astype(np.float16))
        return {
            "scores": scores,
            "reason": "",
            "seconds": estimate.seconds,
            "normals": bool(estimate.normals.size),
            "lights": np.round(np.asarray(estimate.light_directions, np.float64), 6).tolist(),
            "gains": np.round(np.asarray(estimate.intensities, np.float64), 6).tolist(),
            "notes": {name: value for name in _NOTES if (value := getattr(estimate.notes, name)) is not None},
        }


@cache
def code_identity() -> str:
    """Return a text that changes with any file of the project and its libraries; then no older result is reused."""
    root = Path(__file__).parents[2]
    code = source_digest(*(root / package for package in ("render", "sdps", "pipelines")))
    return " ".join([_FORMAT, code, *(f"{name}-{importlib.metadata.version(name)}" for name in _LIBRARIES)])


def _result(known: dict[str, Any], maps: Path) -> Result:
    lights = np.array(known["lights"], np.float32).reshape(-1, 3)
    gains = np.array(known["gains"], np.float32)
    kept = maps if known["normals"] and maps.is_file() else None
    return Result(known["scores"], known["seconds"], known["reason"], lights, gains, kept, known["notes"])
