"""Photographs of the University of Washington's photometric-stereo set (Goldman & Seitz): TGA files in folders.

The layout: `<object>/<object>.<k>.tga` with k from 0, `<object>/<object>.mask.tga`, and next to the objects a `chrome`
sphere under the same lights and `lights.txt`, a number of lights followed by one direction a line (x right, y up, z to
the camera). The values are linear in radiance and the lights equally strong: on the set's own grey sphere Lambert's law
holds to 4 to 8 % of the mean as they are and to 18 to 23 % once a display curve (2.2) is taken off, and the twelve
strengths fitted there differ by under 5 %. The directions in lights.txt are up to 8.5 degrees off those of the chrome
sphere; the grey sphere sides with the chrome one (2.0 degrees on average against 3.2).
"""

import io
from glob import escape
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from pipelines.evaluate.benchmarks.stacks import Images, Stack, build_object
from pipelines.evaluate.evaluation import TestObject
from render.exchange.ingest import crop_box
from render.shared.decoding import check_picture, decoding
from render.shared.errors import InputError
from render.shared.files import read_bytes, read_text

SPHERES = ("chrome", "gray")
"""Folders that calibrate the lights and are not objects."""

_MARGIN = 4
"""Pixels kept around the object."""

_HIGHLIGHT = 0.8
"""Share of the brightest value from which on a pixel of the chrome sphere shows the lamp."""


def list_objects(folder: Path) -> list[str]:
    """Return the objects of a folder by name, calibration spheres left out.

    Raises:
        InputError: no such folder, or none in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; unpack the archive of photographs and name the folder it gives")
    names = sorted(
        path.parent.name for path in folder.glob("*/*.mask.tga") if path.name == f"{path.parent.name}.mask.tga"
    )
    names = [name for name in names if name not in SPHERES]
    if not names:
        raise InputError(f"{folder}: no photographs; want folders like cat/ with cat.0.tga, cat.1.tga ... cat.mask.tga")
    return names


def read_photos(folder: Path, name: str, lights: np.ndarray) -> TestObject:
    """Return an object with the lights (L, 3); 1 is where the camera saturates. Its normals are not known.

    Raises:
        InputError: missing or unreadable files, an empty mask, or another number of lights than of images.
    """
    images, mask = _read_set(folder, name)
    if len(lights) != len(images.files):
        raise InputError(f"{name}: {len(images.files)} images but {len(lights)} lights")
    file = folder / name / f"{name}.mask.tga"
    return build_object(name, images, mask, lights, margin=_MARGIN, files=[file])


def read_lights(folder: Path, source: str = "auto") -> np.ndarray:  # (L, 3)
    """Return the unit light directions, (L, 3) float64, x right, y up, z to the camera.

    Args:
        folder: The folder of all objects.
        source: `chrome` for the highlights on the chrome sphere, `file` for lights.txt, `auto` for the first there is.

    Raises:
        InputError: neither is there, or it is not of the layout.
    """
    if resolve_source(folder, source) == "chrome":
        images, mask = _read_set(folder, "chrome")
        whole = Stack(images, mask, crop_box(mask, None))
        return find_chrome_lights(whole[0 : len(whole)], mask, where=str(folder / "chrome"))
    path = folder / "lights.txt"
    try:
        values = np.array(read_text(path).split(), np.float64)
    except ValueError as error:
        raise InputError(f"{path}: is not all numbers; want a count, then x y z of each light") from error
    if len(values) < 4 or len(values) != 1 + 3 * int(values[0]):
        raise InputError(f"{path}: want a count, then x y z of each light; found {len(values)} numbers")
    directions = values[1:].reshape(-1, 3)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths < 1e-6).any():
        raise InputError(f"{path}: a light has no direction; its x y z are 0 or not finite")
    return directions / lengths


def resolve_source(folder: Path, source: str) -> str:
    """Return `chrome` or `file`, whichever `auto` stands for in this folder.

    Raises:
        InputError: `auto` where neither is there.
    """
    if source != "auto":
        return source
    if (folder / "chrome" / "chrome.mask.tga").is_file():
        return "chrome"
    if not (folder / "lights.txt").is_file():
        raise InputError(f"{folder}: neither a chrome sphere nor lights.txt; calibrated methods need one of them")
    return "file"


def find_chrome_lights(images: np.ndarray, mask: np.ndarray, where: str = "chrome") -> np.ndarray:  # (L, 3)
    """Return the directions of distant lights from their mirror images on a sphere, seen orthographically.

    Args:
        images: (L, H, W, 3) of the sphere.
        mask: (H, W) bool, its disc.
        where: For error messages.

    Raises:
        InputError: a mask that is not a disc, or an image without highlight.
    """
    rows, columns = np.nonzero(mask)
    radius = float(np.sqrt(mask.sum() / np.pi))
    extent = (np.ptp(rows) + 1, np.ptp(columns) + 1)
    if max(abs(side / (2.0 * radius) - 1.0) for side in extent) > 0.05:
        raise InputError(f"{where}: the mask is not a disc ({extent[1]} x {extent[0]} pixels); show the whole sphere")
    inner = ndimage.binary_erosion(mask, iterations=max(1, round(0.03 * radius)))  # the rim mirrors the surroundings
    directions = []
    for number, image in enumerate(images):
        grey = image.mean(-1) * inner
        if grey.max() <= 0.0:
            raise InputError(f"{where}: image {number} shows no highlight")
        parts, count = ndimage.label(grey > _HIGHLIGHT * grey.max())
        largest = 1 + int(np.argmax(ndimage.sum_labels(parts > 0, parts, range(1, count + 1))))
        row, column = ndimage.center_of_mass(parts == largest)
        x, y = (column - columns.mean()) / radius, (rows.mean() - row) / radius  # rows go down, y goes up
        normal = np.array([x, y, np.sqrt(max(1.0 - x * x - y * y, 0.0))])
        directions.append(2.0 * normal[2] * normal - np.array([0.0, 0.0, 1.0]))
    return np.array(directions)


def _read_set(folder: Path, name: str) -> tuple[Images, np.ndarray]:
    """Return the images of a folder and its mask (H, W)."""
    mask = _read(folder / name / f"{name}.mask.tga").max(-1) > 0.5
    middles = [path.name.split(".")[-2] for path in (folder / name).glob(f"{escape(name)}.*.tga")]
    numbers = sorted(int(middle) for middle in middles if middle.isdecimal())
    if len(numbers) < 3 or numbers != list(range(len(numbers))):
        raise InputError(f"{folder / name}: want {name}.0.tga, {name}.1.tga ... without gaps, three at least")
    if not mask.any():
        raise InputError(f"{folder / name}: the mask is empty")
    return Images.of_files([folder / name / f"{name}.{number}.tga" for number in numbers], _read), mask


def _read(path: Path) -> np.ndarray:  # (H, W, 3) float32
    """Read an 8-bit picture as linear values from 0 to 1."""
    data = read_bytes(path)
    with decoding(path, "a picture"), Image.open(io.BytesIO(data)) as picture:
        check_picture(path, picture, data)
        return np.asarray(picture.convert("RGB"), np.float32) / 255.0
