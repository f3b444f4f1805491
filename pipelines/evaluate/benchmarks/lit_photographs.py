"""Photographs with measured lights and no normals: Gourd&Apple and the Light Stage Data Gallery.

Gourd&Apple (Alldrin, Zickler & Kriegman, CVPR 2008) is HDR; its frame is ours: x right, y up, z to the camera, vectors
to the light. The refined lights, corrected by its authors while they fitted the objects, are what published results
compare with.

The Light Stage Data Gallery (Einarsson et al. 2006; USC ICT) shows objects under 253 lights all around. Its vectors
point the way light travels, in the same frame: negated they point to the lights. Published results use the images whose
light is in front of the object.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.evaluate.benchmarks.stacks import Images, build_object
from pipelines.evaluate.evaluation import TestObject
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.images import read_image, to_unit
from render.shared.tables import line_of_row, natural_key, read_names, read_numbers
from sdps.photos.picture_file import decode

_log = logging.getLogger(__name__)

GOURD_APPLE = ("apple", "gourd1", "gourd2")
LIGHT_STAGE = (
    "helmet_side_left", "plant_left", "knight_fighting", "knight_kneeling", "knight_standing", "helmet_front_left",
)  # fmt: skip
_GOURD_APPLE_WANT = "give the folder of apple, gourd1 and gourd2, or one of them; see docs/guides/evaluate.md"
_LIGHT_STAGE_WANT = (
    "give the folder of light_directions.txt and the objects' folders, or one; see docs/guides/evaluate.md"
)
_LIGHTS, _FRONT = 253, 133


def gourd_apple_objects(root: Path, *, refined: bool = True, longest: int = 0) -> list[TestObject]:
    """Return the objects of a folder, or of one object's folder.

    Args:
        root: The folder.
        refined: Take the refined lights rather than the measured ones.
        longest: Greatest side in pixels, 0 for no limit.

    Raises:
        InputError: files that are missing or do not fit together.
    """
    suffix, objects = "_refined" if refined else "", []
    lights = f"light_directions{suffix}.txt"
    folders = [root] if (root / lights).is_file() else object_folders(root, lights, _GOURD_APPLE_WANT)
    for folder in folders:
        directions, _ = read_directions(folder / lights, 1.0)
        intensities = read_intensities(folder / f"light_intensities{suffix}.txt", len(directions))
        images, mask = find_images(folder, (".exr",), len(directions)), folder / "mask.png"
        objects.append(build_object(folder.name, images, read_mask(mask), directions, intensities,
                                    longest=longest, files=[mask]))  # fmt: skip
    return objects


def light_stage_objects(root: Path, *, least_z: float = 0.0, gamma: float = 1.0, longest: int = 0) -> list[TestObject]:
    """Return the objects of a folder, or of one object's folder whose parent holds the lights.

    Args:
        root: The folder.
        least_z: Only images whose unit light direction has z above it are used.
        gamma: Exponent that makes the values of PNG files linear.
        longest: Greatest side in pixels, 0 for no limit.

    Raises:
        InputError: files that are missing or do not fit together.
    """
    single = not (root / "light_directions.txt").is_file() and (root.parent / "light_directions.txt").is_file()
    base = root.resolve().parent if single else root
    folders = [root.resolve()] if single and root.is_dir() else object_folders(base, "*matte.png", _LIGHT_STAGE_WANT)
    if not (base / "light_directions.txt").is_file():
        raise InputError(f"{base}: no light_directions.txt; {_LIGHT_STAGE_WANT}")
    directions, numbers = read_directions(base / "light_directions.txt", -1.0)
    if numbers is not None and not (np.diff(numbers) == 1).all():
        raise InputError(f"{base / 'light_directions.txt'}: lights are not numbered in order; sort its lines")
    intensities = read_intensities(base / "light_intensities.txt", len(directions))
    objects = []
    for folder in folders:
        images = find_images(folder, (".exr", ".png"), len(directions), gamma)
        chosen = np.arange(len(directions))
        if len(images.files) == len(directions):  # an array holds the images in front only, and the lights' files too
            chosen = pick_front(directions, least_z)
            images = _select(images, chosen)
        matte = next((path for path in sorted(folder.glob("*matte.png"))), folder / "matte.png")
        objects.append(build_object(folder.name, images, read_mask(matte), directions[chosen], intensities[chosen],
                                    longest=longest, files=[matte], settings=(gamma,)))  # fmt: skip
    return objects


def _select(images: Images, numbers: np.ndarray) -> Images:
    """Return the images of these numbers, of a file each."""
    files, names = ([whole[number] for number in numbers] for whole in (images.files, images.names))
    return Images(lambda number: images.read(int(numbers[number])), files, names)


def pick_front(directions: np.ndarray, least_z: float) -> np.ndarray:
    """Return the numbers of the lights in front of the object: z above `least_z`.

    Raises:
        InputError: there are none.
    """
    chosen = np.flatnonzero(directions[:, 2] > least_z)
    if not len(chosen):
        raise InputError(f"no light has z > {least_z:g}; vectors of this set point away from the lights")
    if len(directions) == _LIGHTS and len(chosen) != _FRONT:
        _log.warning("%d of the 253 lights have z > %g, the paper used %d", len(chosen), least_z, _FRONT)
    return chosen


def read_mask(path: Path) -> np.ndarray:  # (H, W) bool
    """Read a mask or matte of any values: the value of most of the image's border is the background.

    Gourd&Apple's object is 1; the Light Stage's is dark in the original files and bright in converted ones.

    Raises:
        InputError: missing or damaged, or all on one side.
    """
    pixels = read_image(path, channels=None)
    bright = pixels > pixels.max() // 2
    border = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
    mask = ~bright if border.mean() > 0.5 else bright
    if not mask.any():
        raise InputError(f"{path}: shows no object in front of a background; give the object's mask")
    return mask


def object_folders(root: Path, pattern: str, want: str) -> list[Path]:
    """Return the folders of a benchmark's objects: listed in objects.txt, or the folders with a file of `pattern`.

    Raises:
        InputError: no such folder, or no object in it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; {want}")
    if (root / "objects.txt").is_file():
        return [root / name for name in read_names(root / "objects.txt")]
    folders = sorted({path.parent for path in root.glob(f"[!.]*/{pattern}")}, key=lambda path: natural_key(path.name))
    if not folders:
        raise InputError(f"{root}: no object's folder with {pattern}; {want}")
    return folders


def read_directions(path: Path, sign: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Read light directions of three columns, or four of which the first numbers the lights.

    Args:
        path: The file.
        sign: 1 where vectors point to the light, -1 where they point the way light travels.

    Returns:
        Unit directions (L, 3) float64 from the surface to the light, and the numbers (L,), None where there are none.
    """
    table, numbers = read_table(path)
    length = np.linalg.norm(table, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{path}: line {line_of_row(path, int(np.argmin(length)))} is a zero vector; repair it")
    return sign * table / length, numbers


def read_intensities(path: Path, count: int) -> np.ndarray:  # (L, 3)
    """Read light intensities of R, G and B, numbered or not."""
    table, _ = read_table(path)
    if len(table) != count:
        raise InputError(f"{path}: {len(table)} rows for {count} lights; give one row per light")
    if not (table > 0).all():
        raise InputError(
            f"{path}: line {line_of_row(path, int(np.argmin(table.min(1) > 0)))} is not positive; repair it"
        )
    return table


def read_table(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read (L, 3) numbers, and the numbering (L,) where there is a column of it in front."""
    wide = any(len(line.split()) == 4 for line in read_text(path).splitlines())
    table = read_numbers(path, 4 if wide else 3)
    if not len(table):
        raise InputError(f"{path}: no light in it; give one row per image")
    return (table[:, 1:], table[:, 0]) if wide else (table, None)


def find_images(folder: Path, suffixes: Sequence[str], count: int, gamma: float = 1.0) -> Images:
    """Return the images of an object's folder: of the array that loaders keep, of names.txt, or numbered pictures.

    Args:
        folder: The folder.
        suffixes: Of the pictures; the first that there are any of is taken.
        count: Number of lights.
        gamma: Exponent that makes integers linear; floats are linear already.

    Raises:
        InputError: there are none, or their number is not that of the lights.
    """
    packed, listed = folder / f"{folder.name}_uncalib.npy", folder / "names.txt"
    if packed.is_file():
        return read_packed(packed, count)
    if listed.is_file():
        files, what = [folder / name for name in read_names(listed)], f"{listed}: "
    else:
        numbered = (path for path in folder.glob("*") if path.stem[-1:].isdigit() and not path.name.startswith("."))
        pictures = sorted(numbered, key=lambda path: natural_key(path.name))
        kinds = ([path for path in pictures if path.suffix == suffix] for suffix in suffixes)
        files = next(filter(None, kinds), [])
        if not files:
            wanted = " or ".join(suffixes)
            raise InputError(f"{folder}: no images; want files numbered in their names that end in {wanted}")
        what = f"{folder}: {files[0].suffix} "
    if len(files) != count:
        raise InputError(f"{what}{len(files)} images for {count} lights; give one image per light")

    def read(path: Path) -> np.ndarray:  # (H, W, 3) float32
        pixels = decode(path).pixels
        return pixels if pixels.dtype.kind == "f" else to_unit(pixels) ** np.float32(gamma)

    return Images.of_files(files, read)


def read_packed(path: Path, count: int) -> Images:
    """Return the images in an array (H, W, 3 L), as the loaders of SDPS-Net's family keep them.

    Raises:
        InputError: damaged, or another number of images than of lights.
    """
    with decoding(path, "an array", "convert the images again"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array.ndim != 3 or array.shape[2] != 3 * count:
        raise InputError(f"{path}: is {array.shape}; want height x width x {3 * count}, RGB of {count} lights in turn")
    names = [f"{path}, image {number}" for number in range(count)]
    return Images(lambda number: np.asarray(array[..., 3 * number : 3 * number + 3], np.float32), [path], names)
