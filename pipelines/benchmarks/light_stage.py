"""The Light Stage Data Gallery (Einarsson et al. 2006; USC ICT): objects under 253 lights all around, no normals.

Its direction vectors point the way light travels, in x right, y up, z to the camera: the negated vectors point to the
lights. Published results use the images whose light is in front of the object.
"""

import logging
from pathlib import Path

import numpy as np

from pipelines.benchmarks import lit_photographs as common
from pipelines.evaluate.evaluation import TestObject
from render.shared.errors import InputError
from render.shared.images import read_image

_log = logging.getLogger(__name__)

OBJECTS = (
    "helmet_side_left", "plant_left", "knight_fighting", "knight_kneeling", "knight_standing", "helmet_front_left",
)  # fmt: skip
WANT = "give the folder of light_directions.txt and the objects' folders, or one; see docs/guides/benchmarks.md"

_LIGHTS, _FRONT = 253, 133


def light_stage_objects(root: Path, *, least_z: float = 0.0, gamma: float = 1.0, longest: int = 0) -> list[TestObject]:
    """Return the objects of a folder, or of one object's folder whose parent holds the lights.

    Args:
        root: The folder.
        least_z: Images are used whose unit light direction has z above it.
        gamma: Exponent by which values of PNG files become linear.
        longest: Greatest side in pixels, 0 for no limit.

    Raises:
        InputError: files that are missing or do not fit together.
    """
    single = not (root / "light_directions.txt").is_file() and (root.parent / "light_directions.txt").is_file()
    base = root.resolve().parent if single else root
    folders = [root.resolve()] if single and root.is_dir() else common.object_folders(base, "*matte.png", WANT)
    if not (base / "light_directions.txt").is_file():
        raise InputError(f"{base}: no light_directions.txt; {WANT}")
    directions, numbers = common.read_directions(base / "light_directions.txt", -1.0)
    if numbers is not None and not (np.diff(numbers) == 1).all():
        raise InputError(f"{base / 'light_directions.txt'}: lights are not numbered in order; sort its lines")
    intensities = common.read_intensities(base / "light_intensities.txt", len(directions))
    return [_object(folder, directions, intensities, least_z, gamma, longest) for folder in folders]


def _object(
    folder: Path, directions: np.ndarray, intensities: np.ndarray, least_z: float, gamma: float, longest: int
) -> TestObject:
    count = len(directions)
    packed = folder / f"{folder.name}_uncalib.npy"
    if packed.is_file():  # holds the images in front only, and the lights' files lists these
        chosen, read_all = np.arange(count), common.packed_images(packed, count)
        files, names = [packed], [f"{packed}, image {number}" for number in range(count)]
    else:
        chosen = front(directions, least_z)
        pictures = common.picture_files(folder, (".exr", ".png"), count)
        files = [pictures[number] for number in chosen]
        names, read_all = [str(path) for path in files], common.picture_reader(pictures, gamma)
    matte = next((path for path in sorted(folder.glob("*matte.png"))), folder / "matte.png")
    return common.photographed(
        folder.name, lambda number: read_all(int(chosen[number])), names, object_of_matte(matte),
        directions[chosen], intensities[chosen], files=[*files, matte], settings=(gamma,), longest=longest,
    )  # fmt: skip


def front(directions: np.ndarray, least_z: float) -> np.ndarray:
    """Return the numbers of the lights in front of the object: z above `least_z`.

    Raises:
        InputError: none.
    """
    chosen = np.flatnonzero(directions[:, 2] > least_z)
    if not len(chosen):
        raise InputError(f"no light has z > {least_z:g}; vectors of this set point away from the lights")
    if len(directions) == _LIGHTS and len(chosen) != _FRONT:
        _log.warning("%d of the 253 lights have z > %g, the paper used %d", len(chosen), least_z, _FRONT)
    return chosen


def object_of_matte(path: Path) -> np.ndarray:  # (H, W) bool
    """Read a matte, in which the object is dark in the original files and bright in converted ones.

    The side that most of the image's border is on is the background.

    Raises:
        InputError: missing or damaged, or all on one side.
    """
    pixels = read_image(path, channels=None)
    bright = pixels > pixels.max() // 2
    border = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
    mask = ~bright if border.mean() > 0.5 else bright
    if not mask.any():
        raise InputError(f"{path}: tells no object from the background; give its matte")
    return mask
