"""Reading each layout the way its loaders do, and noting what would make them stumble or misread."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from render.exchange.folders import MARKER, read_record
from render.exchange.foreign_samples import Note, Source, read_mask, read_stack
from render.exchange.read_diligent import diligent_sources
from render.exchange.read_psfcn import psfcn_sources
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.images import MASK_THRESHOLD, bit_depth, decode_normals, read_image, to_unit
from render.shared.tables import check_directions, natural_key, read_names, read_numbers

_LENGTH_TOLERANCE = 0.03  # 8-bit normals deviate from unit length by at most sqrt(3) / 255 = 0.007


class Pictures(NamedTuple):
    """What a loader gets of one sample."""

    folder: Path
    images: np.ndarray  # (L, H, W, 3) float32, full scale 1, per unit intensity
    normals: np.ndarray  # (H, W, 3) float32
    mask: np.ndarray  # (H, W) bool
    directions: np.ndarray | None  # (L, 3)


Samples = list[Callable[[], Pictures]]


def _psfcn_samples(root: Path, note: Note) -> Samples:
    """Check the lists of a PS-FCN tree."""
    for name in ("train_mtrl.txt", "val_mtrl.txt"):
        if not (root / name).is_file():
            note(f"{root / name}: missing; training opens both lists")
    return [partial(_psfcn_pictures, source, note) for source in psfcn_sources(root, note)]


def _psfcn_pictures(source: Source, note: Note) -> Pictures:
    """Read a PS-FCN sample; the loaders divide by 255 and take the mask from the normal map."""
    truth = source.truth()
    coded = read_image(truth.origin)
    if bit_depth(coded) != 8:
        note(f"{truth.origin}: has 16 bits, the loaders divide by 255; save it with 8")
    _check_background(truth.origin, coded, truth.mask, note)
    images, bits = source.stack(truth.mask.shape)
    if bits != 8:
        note(f"{source.folder}: images have 16 bits, the loaders divide by 255; save them with 8")
    return Pictures(source.folder, images, truth.normals, truth.mask, source.directions)


def _check_background(path: Path, coded: np.ndarray, mask: np.ndarray, note: Note) -> None:
    """Check that |n|^2 > 0.01 is the mask, and that what it keeps is of unit length."""
    vectors = to_unit(coded).astype(np.float64) * 2.0 - 1.0
    squared = (vectors**2).sum(-1)
    if ((squared > MASK_THRESHOLD) != mask).any():
        note(
            f"{path}: {int(((squared > MASK_THRESHOLD) != mask).sum())} background pixels are not 127 or 128, so "
            "loaders take them for the object; paint them 128"
        )
    off = np.abs(np.sqrt(squared[mask]) - 1.0) > _LENGTH_TOLERANCE
    if off.any():
        note(f"{path}: {int(off.sum())} object pixels are no unit normals; code (n + 1) / 2 x 255")


def _custom_samples(root: Path, note: Note) -> Samples:
    """Check the list of a custom folder."""
    folders = [root / name for name in read_names(root / "objects.txt")]
    return [partial(_custom_pictures, folder, note) for folder in folders]


def _custom_pictures(folder: Path, note: Note) -> Pictures:
    """Read a custom object; lights and normal.png are optional."""
    names = read_names(folder / "names.txt")
    if names != sorted(names, key=natural_key):
        note(f"{folder / 'names.txt'}: not in natural order; the loader sorts it, but not the lights: sort both alike")
    directions, intensities = None, np.ones((len(names), 3))
    if (folder / "light_directions.txt").is_file():
        path = folder / "light_directions.txt"
        directions = check_directions(read_numbers(path, 3, len(names), "image"), path)
    if (folder / "light_intensities.txt").is_file():
        intensities = read_numbers(folder / "light_intensities.txt", 3, len(names), "image")
    return _object_pictures(folder, names, directions, intensities, "normal.png", note)


def _diligent_samples(root: Path, note: Note) -> Samples:
    """Check the lists of a DiLiGenT root, which SDPS-Net wants beside the published files."""
    base = root / "pmsData" if (root / "pmsData").is_dir() else root
    for name in ("objects.txt", "names.txt"):
        if not (base / name).is_file():
            note(f"{base / name}: missing; SDPS-Net lists objects and images by it")
    common = read_names(base / "names.txt") if (base / "names.txt").is_file() else None
    samples: Samples = []
    for source in diligent_sources(root, note):
        if common is not None and list(source.images) != common:
            note(f"{source.folder / 'filenames.txt'}: differs from {base / 'names.txt'}; name the images alike")
        samples.append(partial(_diligent_pictures, source, note))
    return samples


def _diligent_pictures(source: Source, note: Note) -> Pictures:
    """Read a DiLiGenT object; both forms of its normals must agree where both are there."""
    truth = source.truth()
    text = source.folder / "normal.txt"
    if text.is_file() and truth.origin.name == "Normal_gt.mat":
        try:
            numbers = np.array(read_text(text).split(), np.float64)
        except ValueError:
            numbers = np.zeros(0)  # a word that is no number
        if numbers.size != truth.normals.size or (np.abs(numbers - truth.normals.ravel()) > 1e-4).any():
            note(f"{text}: differs from Normal_gt.mat; write it row by row, x y z, top row first")
    images, _ = source.stack(truth.mask.shape)
    return Pictures(source.folder, images, truth.normals, truth.mask, source.directions)


def _unips_samples(root: Path, note: Note) -> Samples:
    """Find the objects of a UniPS folder."""
    folders = sorted(root.glob("*.data"), key=lambda path: natural_key(path.name))
    if not folders:
        raise InputError(f"{root}: no <object>.data folder; give the folder that holds them")
    return [partial(_unips_pictures, folder, note) for folder in folders]


def _unips_pictures(folder: Path, note: Note) -> Pictures:
    """Read a UniPS object, whose images the loader finds by name and sorts plainly."""
    names = sorted(path.name for path in folder.glob("L*") if not path.name.endswith(".txt"))
    if not names:
        raise InputError(f"{folder}: no L*.png; name the images L000.png, L001.png, ...")
    directions, intensities = None, np.ones((len(names), 3))
    marker = read_record(folder / MARKER) if (folder / MARKER).is_file() else {}
    if "light_directions" in marker:  # mixed light has none
        directions = np.asarray(marker["light_directions"], np.float64)
        intensities = np.repeat(np.asarray(marker["light_intensities"], np.float64)[:, None], 3, 1)
        if names != sorted(names, key=natural_key) or len(directions) != len(names):
            note(f"{folder}: L*.png do not match the lights of {MARKER}; export the object again")
    return _object_pictures(folder, names, directions, intensities, "Normal_gt.png", note)


def _object_pictures(
    folder: Path, names: Sequence[str], directions: np.ndarray | None, intensities: np.ndarray, normal_name: str,
    note: Note,
) -> Pictures:  # fmt: skip
    """Read images, mask and, if it is there, the normal map of an object with a mask of its own."""
    mask = read_mask(folder / "mask.png")
    images, _ = read_stack([folder / name for name in names], mask.shape, intensities)
    normals = np.zeros((*mask.shape, 3), np.float32)
    path = folder / normal_name
    if path.is_file():
        coded = read_image(path)
        if coded.shape[:2] != mask.shape:
            raise InputError(f"{path}: is {coded.shape[:2]}, mask.png is {mask.shape}; give both one size")
        normals, found = decode_normals(coded)
        if (mask & ~found).any():
            note(f"{path}: {int((mask & ~found).sum())} pixels of mask.png have no normal; shrink it")
    return Pictures(folder, images, normals, mask, directions)


SAMPLES: Mapping[str, Callable[[Path, Note], Samples]] = {
    "psfcn": _psfcn_samples,
    "custom": _custom_samples,
    "diligent": _diligent_samples,
    "unips": _unips_samples,
}
