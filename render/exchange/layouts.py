"""The layouts of exchange: names, files of one scene, lists of the whole tree, and what is special about each.

A new layout is a function that writes a scene and an entry of `LAYOUTS`.
"""

import io
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import savemat

from render.exchange.foreign_samples import Source
from render.exchange.names import Place, object_places, view_places
from render.exchange.read_diligent import diligent_sources
from render.exchange.read_psfcn import psfcn_sources
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_text
from render.shared.images import encode_normals, read_image, write_png
from render.shared.tables import format_rows, lines_text


@dataclass(frozen=True, eq=False)
class Sample:
    """One scene, ready to be written.

    Attributes:
        pixels: (L, H, W, 3), uint8 or uint16, linear.
        normals: (H, W, 3) float32, unit in the mask, zero outside.
        mask: (H, W) bool.
        directions: (L, 3) float64, unit, from the surface to the light.
        intensities: (L,) float64, relative to irradiance pi.
    """

    pixels: np.ndarray
    normals: np.ndarray
    mask: np.ndarray
    directions: np.ndarray
    intensities: np.ndarray

    def colours(self) -> np.ndarray:  # (L, 3)
        """Return the intensities as the three columns loaders demand; our lights are white."""
        return np.repeat(self.intensities[:, None], 3, axis=1)


@dataclass(frozen=True)
class Layout:
    """How scenes lie in a tree.

    Attributes:
        about: One line for `--help`.
        base: Folder below the root that holds the scenes.
        bits: Depths its loaders read right; the first is the default.
        exposure: Default exposure.
        intensities: Whether images may have other than unit intensity.
        directions: Whether a file of its own holds the direction of each image's light.
        places: Names the scenes of a manifest.
        folder: Folder of one scene, relative to `base`.
        write: Writes one scene into an empty folder; gets the final folder too, for files next to it.
        lists: Writes what names the scenes in the root; gets (scene, place) in the manifest's order.
        check: Gets the data folder and the scenes' numbers of lights; raises InputError where the tree has no place
            for them.
        advise: Gets the tree and the splits in it; returns what is to be said after an export.
        read: Lists the samples of such a tree for `ingest`; None where it is only written.
    """

    about: str
    base: str
    bits: tuple[int, ...]
    exposure: float | str
    intensities: bool
    directions: bool
    places: Callable[[Sequence[SceneSpec]], dict[str, Place]]
    folder: Callable[[Place], str]
    write: Callable[[Path, Path, Place, Sample], None]
    lists: Callable[[Path, Sequence[tuple[SceneSpec, Place]]], None]
    check: Callable[[str, Collection[int]], None] = lambda folder, counts: None
    advise: Callable[[str, Collection[str]], str] = lambda tree, splits: ""
    read: Callable[[Path], list[Source]] | None = None


def image_names(count: int, pattern: str = "{:03d}.png", first: int = 0) -> list[str]:
    """Return names with equally many digits, so that every kind of sorting keeps the order of the lights."""
    width = len(str(first + count - 1))
    return [pattern.replace("03d", f"0{max(3, width)}d").format(first + number) for number in range(count)]


def _write_images(folder: Path, names: Sequence[str], sample: Sample) -> None:
    for name, pixels in zip(names, sample.pixels, strict=True):
        write_png(folder / name, pixels)


def _write_text(path: Path, lines: Sequence[str]) -> None:
    path.write_text(lines_text(lines), encoding="utf-8", newline="\n")


def _write_lights(folder: Path, sample: Sample) -> None:
    _write_text(folder / "light_directions.txt", format_rows(sample.directions))
    _write_text(folder / "light_intensities.txt", format_rows(sample.colours()))


def _write_mask(folder: Path, sample: Sample) -> None:
    write_png(folder / "mask.png", sample.mask.astype(np.uint8) * 255)


def write_psfcn(folder: Path, final: Path, place: Place, sample: Sample) -> None:
    """Write the images and their list, and next to the folder the normal map the materials of the view share.

    Raises:
        InputError: a normal map is there already and differs.
    """
    coded, path = encode_normals(sample.normals), final.parent / f"{place.shape}_normal.png"
    if not path.exists():
        with atomic_path(path) as temporary:
            write_png(temporary, coded)
    elif not np.array_equal(read_image(path), coded):
        raise InputError(f"{path}: another scene of this view has other normals; render the view's shards again")
    names = image_names(len(sample.pixels))
    _write_images(folder, names, sample)
    rows = [f"{name} {row}" for name, row in zip(names, format_rows(sample.directions), strict=True)]
    _write_text(folder / f"{place.shape}_{place.name}.txt", rows)


def list_psfcn(root: Path, placed: Sequence[tuple[SceneSpec, Place]]) -> None:
    """Write train_mtrl.txt and val_mtrl.txt, and test_mtrl.txt where there are test scenes."""
    for split in ("train", "val", "test"):
        lines = [f"{place.shape}/{place.name}" for scene, place in placed if scene.split == split]
        if lines or split != "test":
            write_text(root / f"{split}_mtrl.txt", lines_text(lines))


def _check_psfcn(folder: str, counts: Collection[int]) -> None:
    if min(counts) < 2:
        raise InputError(f"{folder}: a scene has one light, but PS-FCN's loaders need at least two")


def _advise_psfcn(tree: str, splits: Collection[str]) -> str:
    if "val" in splits:
        return ""
    return f"{tree}: val_mtrl.txt is empty; export scenes of split 'val' too before training on it\n"


def write_custom(folder: Path, _final: Path, _place: Place, sample: Sample) -> None:
    """Write images, mask, lights and normal.png of a UPS_Custom_Dataset object."""
    names = image_names(len(sample.pixels))
    _write_images(folder, names, sample)
    _write_text(folder / "names.txt", names)
    _write_mask(folder, sample)
    _write_lights(folder, sample)
    write_png(folder / "normal.png", encode_normals(sample.normals))


def list_custom(root: Path, placed: Sequence[tuple[SceneSpec, Place]]) -> None:
    """Write objects.txt."""
    write_text(root / "objects.txt", lines_text([place.name for _, place in placed]))


def write_diligent(folder: Path, _final: Path, _place: Place, sample: Sample) -> None:
    """Write a DiLiGenT object: numbered images, mask, lights, and its normals as .mat, .txt and .png."""
    names = image_names(len(sample.pixels), first=1)
    _write_images(folder, names, sample)
    _write_text(folder / "filenames.txt", names)
    _write_mask(folder, sample)
    _write_lights(folder, sample)
    write_png(folder / "Normal_gt.png", encode_normals(sample.normals))
    # In memory first: savemat would leave a full disk's OSError to a destructor.
    buffer = io.BytesIO()
    normals = {"Normal_gt": sample.normals.astype(np.float64)}
    savemat(buffer, normals, do_compression=True)  # type: ignore[arg-type]  # the stubs know of paths alone
    (folder / "Normal_gt.mat").write_bytes(buffer.getvalue())
    # One number per line and none after the last line's end: CNN-PS converts every line to a number.
    numbers = [f"{value:.6f}" if value else "0" for value in sample.normals.ravel().tolist()]
    (folder / "normal.txt").write_text("\n".join(numbers), encoding="utf-8", newline="\n")


def _check_diligent(folder: str, counts: Collection[int]) -> None:
    if len(counts) > 1:
        raise InputError(
            f"{folder}: scenes have from {min(counts)} to {max(counts)} lights, but a DiLiGenT root has one names.txt "
            "for all; export them to folders of their own with --ids"
        )


def list_diligent(root: Path, placed: Sequence[tuple[SceneSpec, Place]]) -> None:
    """Write objects.txt and names.txt into pmsData, which SDPS-Net reads instead of looking into the folders."""
    root = root / "pmsData"
    counts = {len(scene.lights) for scene, _ in placed}
    write_text(root / "objects.txt", lines_text([f"{place.name}PNG" for _, place in placed]))
    write_text(root / "names.txt", lines_text(image_names(max(counts, default=0), first=1)))


def write_unips(folder: Path, _final: Path, _place: Place, sample: Sample) -> None:
    """Write L*.png, mask.png and Normal_gt.png; the layout has no file for lights, which stand in scene.json."""
    _write_images(folder, image_names(len(sample.pixels), "L{:03d}.png"), sample)
    _write_mask(folder, sample)
    write_png(folder / "Normal_gt.png", encode_normals(sample.normals))


LAYOUTS: Mapping[str, Layout] = {
    "psfcn": Layout("PS-FCN / SDPS-Net training tree", "Images", (8,), 1.0, False, True, view_places,
                    lambda place: f"{place.shape}/{place.name}", write_psfcn, list_psfcn,
                    _check_psfcn, _advise_psfcn, psfcn_sources),
    "custom": Layout("SDPS-Net's UPS_Custom_Dataset folder", "", (8, 16), "auto", True, True, object_places,
                     lambda place: place.name, write_custom, list_custom),
    "diligent": Layout("DiLiGenT's pmsData folder", "pmsData", (16, 8), "auto", True, True, object_places,
                       lambda place: f"{place.name}PNG", write_diligent, list_diligent,
                       _check_diligent, read=diligent_sources),
    "unips": Layout("UniPS / SDM-UniPS test folder", "", (16, 8), "auto", True, False, object_places,
                    lambda place: f"{place.name}.data", write_unips, lambda root, placed: None),
}  # fmt: skip
