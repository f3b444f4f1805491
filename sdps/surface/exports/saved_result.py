"""The folder that `sdps infer` writes, read again."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import parse_json, read_json, read_text
from render.shared.images import read_image
from sdps.core.geometry import Camera
from sdps.photos.faults import Faults
from sdps.photos.light_files import read_lights

if TYPE_CHECKING:
    from sdps.inference.image_source import ImageSource

_AGAIN = "run `sdps infer` again"
_UNIT = 1.001
_MOST = 1e9  # of any number; more is in a damaged file
RESULT = "result.json"


@dataclass(frozen=True, eq=False)
class SavedLights:
    """The lights of a result.

    Attributes:
        files: (L,) names of the photographs.
        directions: (L, 3) float32, unit, from the surface to the light; x right, y up, z to the camera.
        intensities: (L,) or (L, 3) float32, up to one common scale.
        nearness: (L,) float64, the object's radius over each lamp's distance (`sdps.core.geometry`); None: distant.
    """

    files: tuple[str, ...]
    directions: np.ndarray
    intensities: np.ndarray
    nearness: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class SavedResult:
    """What a folder of `sdps infer` holds. Frame: x right, y up, z to the camera.

    Attributes:
        folder: The folder.
        facts: result.json.
        normals: (H, W, 3) float32, unit, zero outside the mask.
        mask: (H, W) bool.
        depth: (H, W) float32, pixels towards the camera (in the file millimetres, where `pixel_size` is known).
        camera: The camera.
        pixel_size: Millimetres that a pixel shows at depth 0; None where it is not known.
        lights: The lights; None of methods that find normals alone.
        pictures: The photographs, where they are at hand.

    Raises:
        InputError: arrays of different sizes, values that are not finite, or an empty mask.
    """

    folder: Path
    facts: dict[str, Any]
    normals: np.ndarray
    mask: np.ndarray
    depth: np.ndarray
    camera: Camera
    pixel_size: float | None = None
    lights: SavedLights | None = None
    pictures: "ImageSource | None" = None

    def __post_init__(self) -> None:
        shape = self.mask.shape
        for name, array, wanted in (("normal.npy", self.normals, (*shape, 3)), ("depth.npy", self.depth, shape)):
            if array.shape != wanted:
                raise InputError(f"{self.folder / name}: is {array.shape}, where mask.png wants {wanted}; {_AGAIN}")
            if not np.abs(array).max(initial=0.0) < _MOST:
                raise InputError(f"{self.folder / name}: has values that are not finite; {_AGAIN}")
        if np.abs(self.normals).max(initial=0.0) > _UNIT:
            raise InputError(f"{self.folder / 'normal.npy'}: has vectors longer than 1; {_AGAIN}")
        if not self.mask.any():
            raise InputError(f"{self.folder / 'mask.png'}: is empty; {_AGAIN}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns (H, W)."""
        return self.mask.shape[0], self.mask.shape[1]

    @property
    def unit(self) -> str:
        """Unit of lengths in exported files: mm, or pixels where their size is not known."""
        return "mm" if self.pixel_size else "pixels"

    @property
    def unit_size(self) -> float:
        """Length of a pixel in `unit`."""
        return self.pixel_size or 1.0

    @cached_property
    def albedo(self) -> np.ndarray | None:
        """Diffuse albedo (H, W, 3) float32, relative; None where nothing was refined."""
        return self._optional("albedo.npy")

    @cached_property
    def highlights(self) -> np.ndarray | None:
        """Strength of the highlights, float32, first sides (H, W); None where nothing was refined."""
        return self._optional("highlights.npy")

    @cached_property
    def expected_error(self) -> np.ndarray | None:
        """Angle to the true normals to expect, (H, W) float32 in degrees; None where it is not known."""
        return self._optional("expected-error.npy")

    def _optional(self, name: str) -> np.ndarray | None:
        """Return an array (H, W, ...) of the folder, None where it has none.

        Raises:
            InputError: damaged, or of another size.
        """
        path = self.folder / name
        if not path.is_file():
            return None
        array = _read_array(path)
        if array.shape[:2] != self.shape:
            raise InputError(f"{path}: is {array.shape}, where mask.png is {self.shape}; {_AGAIN}")
        if not np.abs(array).max(initial=0.0) < _MOST:
            raise InputError(f"{path}: has values that are not finite; {_AGAIN}")
        return array


def read_result(folder: str | Path) -> SavedResult:
    """Read a folder that `sdps infer` has written.

    Raises:
        InputError: no such folder, one without result.json, or files that are damaged or do not fit together.
    """
    folder = Path(folder)
    if not (folder / RESULT).is_file():
        raise InputError(f"{folder}: no result of `sdps infer` ({RESULT} is missing); name the folder of its --out")
    facts = read_json(folder / RESULT, _AGAIN)
    if not isinstance(facts, dict):
        raise InputError(f"{folder / RESULT}: is not a result of `sdps infer`; {_AGAIN}")
    size, camera = _read_scale(folder / RESULT, facts)
    depth = _read_array(folder / "depth.npy")
    return SavedResult(
        folder, facts, _read_array(folder / "normal.npy"), read_image(folder / "mask.png", channels=None) > 0,
        depth / np.float32(size) if size else depth, camera, size, _read_lights(folder),
    )  # fmt: skip


def _read_scale(path: Path, facts: dict[str, Any]) -> tuple[float | None, Camera]:
    """Return millimetres per pixel, None where they are not known, and the camera of result.json."""
    try:
        size, known = facts.get("pixel_size"), facts.get("camera_pixels")
        if size is not None and not 1.0 / _MOST < float(size) < _MOST:
            raise ValueError(f"pixel_size {size}")
        if known is None:
            if not str(facts.get("camera", "orthographic")).startswith("orthographic"):
                raise InputError(f"{path}: of an earlier version, without the camera's numbers; {_AGAIN}")
            return size and float(size), Camera()
        column, row = map(float, known["principal"])
        return size and float(size), Camera(float(known["focal"] or np.inf), (column, row))
    except (TypeError, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: its camera or scale cannot be read ({error}); {_AGAIN}") from error


def _read_array(path: Path) -> np.ndarray:
    """Return a .npy file of floats, whose size in memory is that of the file."""
    if not path.is_file():
        raise InputError(f"{path}: missing; {_AGAIN}")
    with decoding(path, "a NumPy file", _AGAIN):
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # its header may claim more than there is
        if array.dtype.kind != "f" or array.ndim < 2:
            raise InputError(f"{path}: is {array.dtype} {array.shape}, not a picture of numbers; {_AGAIN}")
        return np.array(array, np.float32)


def _read_lights(folder: Path) -> SavedLights | None:
    path = folder / "lights.json"
    if not path.is_file():
        return None
    try:
        files = tuple(str(image["file"]) for image in parse_json(read_text(path))["images"])
    except (TypeError, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a lights.json ({error}); {_AGAIN}") from error
    found = read_lights(path, files, faults=Faults(anyway=True))  # a method may find lights behind the object
    gains = np.ones(len(files), np.float32) if found.intensities is None else found.intensities
    nearness = None if found.distances is None else 0.5 / found.distances
    return SavedLights(files, found.directions, gains, nearness)
