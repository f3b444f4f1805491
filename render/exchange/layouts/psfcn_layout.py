"""PS-FCN / SDPS-Net training trees: written, and read as strictly as their loaders do."""

import re
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from render.exchange.layouts.foreign_samples import Note, Source, Truth, refuse_several
from render.exchange.layouts.layout_base import Layout, Sample, image_names, legal_name, unique_names, write_lines
from render.records.manifest import SceneSpec
from render.shared.errors import InputError
from render.shared.files import atomic_path, read_text, write_text
from render.shared.images import MASK_THRESHOLD, decode_normals, encode_normals, read_image, to_unit, write_png
from render.shared.tables import format_rows, lines_text, read_light_list, read_names

_SPLITS = ("train", "val", "test")
_LENGTH_TOLERANCE = 0.03  # 8-bit normals deviate from unit length by at most sqrt(3) / 255 = 0.007


class PsFcn(Layout):
    """Materials of one view share a folder and a normal map; lists name the samples of each split."""

    about = "PS-FCN / SDPS-Net training tree"
    bits = (8,)
    exposure = 1.0
    intensities = False
    importable = True
    crop = 128

    def name_folders(self, scenes: Sequence[SceneSpec]) -> dict[str, str]:
        """Give the scenes that show one object in one view a common folder, and in it one folder per material.

        Such scenes have one normal map; the view's name is what their ids have in common before `-m<number>`, else
        the name of the shape.
        """
        views: dict[tuple[Hashable, ...], list[SceneSpec]] = {}
        for scene in scenes:
            # The seed and the samples decide the rounding of the normals, so they are part of what is common.
            key: tuple[Hashable, ...] = (scene.shape, scene.view, scene.size, scene.seed, scene.spp)
            if scene.shape.startswith("imported:"):
                key += (scene.id,)  # nothing says that two imported scenes of one name are one view
            views.setdefault(key, []).append(scene)
        shapes = unique_names([_name_view(group) for group in views.values()])
        folders: dict[str, str] = {}
        for shape, group in zip(shapes, views.values(), strict=True):
            materials = unique_names([legal_name(scene.material) for scene in group])
            folders |= {scene.id: f"Images/{shape}/{name}" for scene, name in zip(group, materials, strict=True)}
        return folders

    def check_lights(self, counts: set[int], folder: Path) -> None:
        if min(counts) < 2:
            raise InputError(f"{folder}: a scene has one light, but PS-FCN's loaders need at least two")

    def write(self, folder: Path, final: Path, sample: Sample) -> None:
        """Write the images and their list, and next to the folder the normal map the materials of the view share.

        Raises:
            InputError: a normal map is there already and differs.
        """
        shape, material = final.parts[-2:]
        coded, path = encode_normals(sample.normals), final.parent / f"{shape}_normal.png"
        if not path.exists():
            with atomic_path(path) as temporary:
                write_png(temporary, coded)
        elif not np.array_equal(read_image(path), coded):
            raise InputError(f"{path}: another scene of this view has other normals; render the view's shards again")
        names = image_names(len(sample.pixels))
        sample.write_images(folder, names)
        rows = [f"{name} {row}" for name, row in zip(names, format_rows(sample.directions), strict=True)]
        write_lines(folder / f"{shape}_{material}.txt", rows)

    def write_lists(self, root: Path, placed: Sequence[tuple[SceneSpec, str]]) -> None:
        """Write train_mtrl.txt and val_mtrl.txt, and test_mtrl.txt where there are test scenes."""
        for split in _SPLITS:
            lines = [folder.removeprefix("Images/") for scene, folder in placed if scene.split == split]
            if lines or split != "test":
                write_text(root / f"{split}_mtrl.txt", lines_text(lines))

    def describe_gaps(self, splits: set[str]) -> str:
        if "val" in splits:
            return ""
        return "val_mtrl.txt is empty; export scenes of split 'val' too before training on it"

    def list_samples(self, tree: Path) -> Sequence[Callable[[], Source]]:
        lists = {split: tree / f"{split}_mtrl.txt" for split in _SPLITS}
        if not any(path.is_file() for path in lists.values()):
            refuse_several(tree, "*/train_mtrl.txt", 1)
            raise InputError(f"{tree}: no train_mtrl.txt or val_mtrl.txt; give the folder that holds them and Images/")
        samples: list[Callable[[], Source]] = []
        seen: dict[str, str] = {}
        for split, path in lists.items():
            if path.is_file() and read_text(path).strip():
                samples += [partial(_read_sample, tree, entry, split, seen) for entry in read_names(path)]
        if not samples:
            raise InputError(f"{tree}: its lists name no sample; write '<shape>/<material>' lines into train_mtrl.txt")
        return samples

    def check_lists(self, tree: Path, sources: Sequence[Source], note: Note) -> None:
        for name in ("train_mtrl.txt", "val_mtrl.txt"):
            if not (tree / name).is_file():
                note(f"{tree / name}: missing; training opens both lists")

    def check_sample(self, source: Source, truth: Truth, bits: int, note: Note) -> None:
        """Check the depths, and that |n|^2 > 0.01 is the mask and keeps vectors of unit length."""
        path, coded = truth.origin, read_image(truth.origin)
        if coded.dtype != np.uint8:
            note(f"{path}: has 16 bits, the loaders divide by 255; save it with 8")
        if bits != 8:
            note(f"{source.folder}: images have 16 bits, the loaders divide by 255; save them with 8")
        squared = ((to_unit(coded).astype(np.float64) * 2.0 - 1.0) ** 2).sum(-1)
        stray = int(((squared > MASK_THRESHOLD) != truth.mask).sum())
        if stray:
            note(
                f"{path}: {stray} background pixels are not 127 or 128, so loaders take them for the object; paint "
                "them 128"
            )
        off = int((np.abs(np.sqrt(squared[truth.mask]) - 1.0) > _LENGTH_TOLERANCE).sum())
        if off:
            note(f"{path}: {off} object pixels are not unit normals; code (n + 1) / 2 x 255")


def _name_view(group: Sequence[SceneSpec]) -> str:
    """Return the stem of the ids, or the shape."""
    stems = {re.sub(r"-m[0-9]+$", "", scene.id) for scene in group}
    numbered = all(re.search(r"-m[0-9]+$", scene.id) for scene in group)
    return legal_name(stems.pop() if numbered and len(stems) == 1 else group[0].shape)


def _read_sample(tree: Path, entry: str, split: str, seen: dict[str, str]) -> Source:
    """Read the list of lights of one sample, named by an entry of a split's list; `seen` collects entries read."""
    path = tree / f"{split}_mtrl.txt"
    if entry in seen:
        raise InputError(f"{path}: {entry!r} is in {seen[entry]}_mtrl.txt too; keep it in one list")
    seen[entry] = split
    if entry.count("/") != 1 or {"", ".", ".."} & set(entry.split("/")):
        raise InputError(f"{path}: {entry!r} is not '<shape>/<material>' with exactly one '/'; write it so")
    shape, material = entry.split("/")
    folder = tree / "Images" / shape / material
    names, directions = read_light_list(folder / f"{shape}_{material}.txt")
    normals = tree / "Images" / shape / f"{shape}_normal.png"  # its background gives the mask
    return Source(
        shape=shape, material=material, split=split, folder=folder, where=f"Images/{entry}", images=names,
        directions=directions, intensities=np.ones_like(directions),
        truth=lambda: Truth.of(*decode_normals(read_image(normals)), normals),
    )  # fmt: skip
