"""Reading PS-FCN / SDPS-Net training trees, as strictly as their loaders."""

from pathlib import Path

import numpy as np

from render.exchange.foreign_samples import Note, Source, checked_truth, noted, refuse_several
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.images import decode_normals, read_image
from render.shared.tables import read_light_list, read_names


def psfcn_sources(tree: str | Path, note: Note | None = None) -> list[Source]:
    """List the samples of a PS-FCN / SDPS-Net training tree, by its train, val and test lists.

    Args:
        tree: Root of the tree.
        note: Gets the complaint about a sample, which is then left out; without it the complaint is raised.

    Raises:
        InputError: not such a tree, several trees, or a list the loaders would misread.
    """
    root = Path(tree)
    lists = {split: root / f"{split}_mtrl.txt" for split in ("train", "val", "test")}
    if not any(path.is_file() for path in lists.values()):
        refuse_several(root, "*/train_mtrl.txt", 1)
        raise InputError(f"{root}: no train_mtrl.txt or val_mtrl.txt; give the folder that holds them and Images/")
    sources: list[Source] = []
    seen: dict[str, Path] = {}
    for split, path in lists.items():
        if not path.is_file() or not read_text(path).strip():
            continue
        for entry in read_names(path):
            with noted(note):
                if entry in seen:
                    raise InputError(f"{path}: {entry!r} is in {seen[entry].name} too; keep it in one list")
                seen[entry] = path
                sources.append(_psfcn_source(root, entry, split, path))
    if not sources:
        raise InputError(f"{root}: its lists name no sample; write '<shape>/<material>' lines into train_mtrl.txt")
    return sources


def _psfcn_source(root: Path, entry: str, split: str, listed: Path) -> Source:
    """Read the list of lights of one sample, named by an entry of the list `listed`."""
    if entry.count("/") != 1 or {"", ".", ".."} & set(entry.split("/")):
        raise InputError(f"{listed}: {entry!r} is not '<shape>/<material>' with exactly one '/'; write it so")
    shape, material = entry.split("/")
    folder = root / "Images" / shape / material
    names, directions = read_light_list(folder / f"{shape}_{material}.txt")
    normals = root / "Images" / shape / f"{shape}_normal.png"  # its background gives the mask
    return Source(
        name=f"{shape}_{material}", shape=shape, material=material, split=split, folder=folder,
        where=f"Images/{entry}", images=tuple(names), directions=directions, intensities=np.ones_like(directions),
        truth=lambda: checked_truth(*decode_normals(read_image(normals)), normals),
    )  # fmt: skip
