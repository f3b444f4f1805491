"""Reading DiLiGenT folders (Shi et al. 2016)."""

import math
from pathlib import Path

import numpy as np
from scipy.io import loadmat, whosmat

from render.exchange.foreign_samples import (
    Note,
    Source,
    Truth,
    checked_truth,
    noted,
    read_mask,
    refuse_several,
    size_text,
)
from render.shared.decoding import check_unpacked, decoding
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.images import decode_normals, read_image
from render.shared.tables import check_directions, line_of_row, natural_key, read_names, read_numbers


def diligent_sources(tree: str | Path, note: Note | None = None) -> list[Source]:
    """List the objects of a DiLiGenT folder: its root, the folder above `pmsData`, or one object's folder.

    Args:
        tree: The folder.
        note: Gets the complaint about an object, which is then left out; without it the complaint is raised.

    Raises:
        InputError: not such a folder, several roots, or a file that is missing or of another length.
    """
    root = Path(tree)
    if (root / "pmsData").is_dir():
        root = root / "pmsData"
    if (root / "light_directions.txt").is_file():
        return [_diligent_source(root, root.parent)]
    if (root / "objects.txt").is_file():
        folders = [root / name for name in read_names(root / "objects.txt")]
    else:
        found = {path.parent for path in root.glob("[!.]*/light_directions.txt")}
        folders = sorted(found, key=lambda path: natural_key(path.name))
    if not folders:
        refuse_several(root, "*/*/light_directions.txt", 2)
        raise InputError(f"{root}: no folder with light_directions.txt; give DiLiGenT's pmsData or one <object>PNG")
    sources = []
    for folder in folders:
        with noted(note):
            sources.append(_diligent_source(folder, root))
    return sources


def _diligent_source(folder: Path, root: Path) -> Source:
    """Read the text files of one object."""
    lists = [path for path in (folder / "filenames.txt", root / "names.txt") if path.is_file()]
    if lists:
        names = read_names(lists[0])
    else:
        names = sorted((path.name for path in folder.glob("[0-9]*.png")), key=natural_key)
    if not names:
        raise InputError(f"{folder}: no filenames.txt and no 001.png, 002.png, ...; give one image per light")
    path = folder / "light_directions.txt"
    directions = check_directions(read_numbers(path, 3, len(names), "image"), path)
    path = folder / "light_intensities.txt"
    intensities = read_numbers(path, 3, len(names), "image")
    if not (intensities > 0).all():
        raise InputError(
            f"{path}: line {line_of_row(path, int(np.argmin(intensities.min(1) > 0)))} is not positive; repair it"
        )
    name = folder.name.removesuffix("PNG") or folder.name
    return Source(
        name=name, shape=name, material=name, split="test", folder=folder, where=folder.name, images=tuple(names),
        directions=directions, intensities=intensities, truth=lambda: _diligent_truth(folder),
    )  # fmt: skip


def _diligent_truth(folder: Path) -> Truth:
    """Read the mask, and the normals from Normal_gt.mat, normal.txt or Normal_gt.png, whichever is there first.

    The .mat comes first, because harvest's normal.txt is upside down in the published archive.
    """
    mask = read_mask(folder / "mask.png")
    origins = [folder / name for name in ("Normal_gt.mat", "normal.txt", "Normal_gt.png")]
    origin = next((path for path in origins if path.is_file()), None)
    if origin is None:
        raise InputError(f"{folder}: no Normal_gt.mat, normal.txt or Normal_gt.png; shards need ground-truth normals")
    if origin.suffix == ".png":
        normals = decode_normals(read_image(origin))[0]
    elif origin.suffix == ".txt":
        numbers = np.array(read_text(origin).split())
        if numbers.size != mask.size * 3:
            raise InputError(
                f"{origin}: {numbers.size} numbers for a mask of {size_text(mask.shape)}; give 3 per pixel"
            )
        try:
            normals = numbers.astype(np.float64).reshape(*mask.shape, 3)
        except ValueError as error:
            raise InputError(f"{origin}: holds something that is not a number ({error}); restore the file") from error
    else:
        normals = _read_mat(origin)
    if normals.shape != (*mask.shape, 3):
        raise InputError(
            f"{folder / 'mask.png'}: is {size_text(mask.shape)}, {origin.name} is {size_text(normals.shape)} "
            "(height x width); give both one size"
        )
    return checked_truth(normals, mask, origin)


def _read_mat(path: Path) -> np.ndarray:
    """Read the array `Normal_gt`."""
    with decoding(path, "a MATLAB file of version 7 or below", "save it with -v7"):
        check_unpacked(path, sum(8 * math.prod(shape) for _, shape, _ in whosmat(path)), "its variables")
        content = loadmat(path)
    if "Normal_gt" not in content:
        keys = ", ".join(sorted(key for key in content if not key.startswith("__")))
        raise InputError(f"{path}: no variable Normal_gt (it has: {keys or 'none'}); save the normals under that name")
    normals = np.asarray(content["Normal_gt"])
    if normals.ndim != 3 or normals.shape[2] != 3 or normals.dtype.kind not in "fiu":
        raise InputError(f"{path}: Normal_gt is {normals.dtype} of shape {normals.shape}; want height x width x 3")
    return normals.astype(np.float64)
