"""DiLiGenT folders (Shi et al. 2016), written and read."""

import io
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat, whosmat

from render.exchange.layouts.foreign_samples import Note, Source, Truth, read_lights, read_mask, refuse_several
from render.exchange.layouts.layout_base import Layout, Sample, image_names, write_lines
from render.records.manifest import SceneSpec
from render.shared.decoding import check_unpacked, decoding
from render.shared.errors import InputError
from render.shared.files import read_text, write_text
from render.shared.images import decode_normals, read_image
from render.shared.tables import lines_text, natural_key, read_names


class Diligent(Layout):
    """A folder per object, with its normals as .mat, .txt and .png; one list of image names for all."""

    about = "DiLiGenT's pmsData folder"
    folder_pattern = "pmsData/{}PNG"
    importable = True

    def check_lights(self, counts: set[int], folder: Path) -> None:
        if len(counts) > 1:
            raise InputError(
                f"{folder}: scenes have from {min(counts)} to {max(counts)} lights, but a DiLiGenT root has one "
                "names.txt for all; export them to folders of their own with --ids"
            )

    def write(self, folder: Path, final: Path, sample: Sample) -> None:
        names = image_names(len(sample.pixels), first=1)
        sample.write_images(folder, names)
        write_lines(folder / "filenames.txt", names)
        sample.write_lights(folder)
        sample.write_truth(folder, "Normal_gt.png")
        # In memory first: savemat would leave a full disk's OSError to a destructor.
        buffer = io.BytesIO()
        normals = {"Normal_gt": sample.normals.astype(np.float64)}
        savemat(buffer, normals, do_compression=True)  # type: ignore[arg-type]  # the stubs know of paths alone
        (folder / "Normal_gt.mat").write_bytes(buffer.getvalue())
        # One number per line and none after the last line's end: CNN-PS converts every line to a number.
        numbers = [f"{value:.6f}" if value else "0" for value in sample.normals.ravel().tolist()]
        (folder / "normal.txt").write_text("\n".join(numbers), encoding="utf-8", newline="\n")

    def write_lists(self, root: Path, placed: Sequence[tuple[SceneSpec, str]]) -> None:
        """Write objects.txt and names.txt into pmsData, which SDPS-Net reads instead of looking into the folders."""
        counts = {len(scene.lights) for scene, _ in placed}
        write_text(root / "pmsData" / "objects.txt", lines_text([Path(folder).name for _, folder in placed]))
        write_text(root / "pmsData" / "names.txt", lines_text(image_names(max(counts, default=0), first=1)))

    def list_samples(self, tree: Path) -> Sequence[Callable[[], Source]]:
        """List the objects of a DiLiGenT folder: its root, the folder above `pmsData`, or one object's folder."""
        root = _find_root(tree)
        if (root / "light_directions.txt").is_file():
            return [partial(_read_object, root)]
        if (root / "objects.txt").is_file():
            folders = [root / name for name in read_names(root / "objects.txt")]
        else:
            found = {path.parent for path in root.glob("[!.]*/light_directions.txt")}
            folders = sorted(found, key=lambda path: natural_key(path.name))
        if not folders:
            refuse_several(root, "*/*/light_directions.txt", 2)
            raise InputError(f"{root}: no folder with light_directions.txt; give DiLiGenT's pmsData or one <object>PNG")
        return [partial(_read_object, folder) for folder in folders]

    def check_lists(self, tree: Path, sources: Sequence[Source], note: Note) -> None:
        """Check the lists of the root, which SDPS-Net wants in addition to the published files."""
        root = _find_root(tree)
        for name in ("objects.txt", "names.txt"):
            if not (root / name).is_file():
                note(f"{root / name}: missing; SDPS-Net lists objects and images by it")
        common = read_names(root / "names.txt") if (root / "names.txt").is_file() else None
        for source in sources:
            if common is not None and list(source.images) != common:
                note(f"{source.folder / 'filenames.txt'}: differs from {root / 'names.txt'}; name the images alike")

    def check_sample(self, source: Source, truth: Truth, bits: int, note: Note) -> None:
        """Check that both forms of the normals agree where both are there."""
        text = source.folder / "normal.txt"
        if not text.is_file() or truth.origin.name != "Normal_gt.mat":
            return
        try:
            numbers = np.array(read_text(text).split(), np.float64)
        except ValueError:
            numbers = np.zeros(0)  # a word that is not a number
        if numbers.size != truth.normals.size or (np.abs(numbers - truth.normals.ravel()) > 1e-4).any():
            note(f"{text}: differs from Normal_gt.mat; write it row by row, x y z, top row first")


def _find_root(tree: Path) -> Path:
    """Return the folder of the objects, which may be the `pmsData` below."""
    return tree / "pmsData" if (tree / "pmsData").is_dir() else tree


def _read_object(folder: Path) -> Source:
    """Read the text files of one object."""
    lists = [path for path in (folder / "filenames.txt", folder.parent / "names.txt") if path.is_file()]
    if lists:
        names = read_names(lists[0])
    else:
        names = sorted((path.name for path in folder.glob("[0-9]*.png")), key=natural_key)
    if not names:
        raise InputError(f"{folder}: no filenames.txt and no 001.png, 002.png, ...; give one image per light")
    return Source.of_object(folder, "PNG", names, read_lights(folder, len(names)), partial(_read_truth, folder))


def _read_truth(folder: Path) -> Truth:
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
        normals = _read_text_normals(origin, *mask.shape)
    else:
        normals = _read_mat(origin)
    return Truth.of(normals, mask, origin)


def _read_text_normals(path: Path, height: int, width: int) -> np.ndarray:
    """Read one normal per pixel."""
    numbers = np.array(read_text(path).split())
    if numbers.size != height * width * 3:
        raise InputError(f"{path}: {numbers.size} numbers for a mask of {height}x{width}; give 3 per pixel")
    try:
        return numbers.astype(np.float64).reshape(height, width, 3)
    except ValueError as error:
        raise InputError(f"{path}: holds something that is not a number ({error}); restore the file") from error


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
