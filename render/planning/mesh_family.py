"""The family `meshes`: mesh files of the user's own, drawn in a seeded order."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from render.records.manifest import OWN_MESHES
from render.shared.errors import InputError, unknown
from render.shared.progress import progress_bar
from render.shared.seeds import generator

AXES = ("x", "y", "z")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class MeshFamily:
    """Mesh files of the user's own, the shapes of the family `meshes`.

    Attributes:
        path: Files, and folders whose mesh files are taken, those of folders inside included. Relative to the folder
            the command runs in, as all paths in presets.
        up: Axis of the files that points up, which becomes y; glTF has y, many programs write STL and OBJ with z.
        upright: Whether the shapes stand, and get the poses of sculptures; otherwise they are turned any way, as blobs.
        licence: Terms of the meshes, which the dataset card names.
    """

    path: tuple[str, ...]
    up: str = "y"
    upright: bool = True
    licence: str = ""

    def __post_init__(self) -> None:
        if not self.path or not all(self.path):
            raise InputError("meshes.path must name at least one folder or file")
        if self.up not in AXES:
            raise unknown("value for meshes.up:", self.up, AXES)


def choose(family: MeshFamily, seed: int, count: int) -> list[str]:
    """Name the first `count` usable files, or all there are, in an order that the seed decides.

    What cannot be used is passed over with a warning of one line: damaged files, and copies of another file, which
    could come into both splits.

    Args:
        family: Where the files are.
        seed: Root seed.
        count: Shapes wanted; no more files are read than that takes.

    Returns:
        Names for `render.shapes.load`. A larger count only adds names at the end.

    Raises:
        InputError: a path that is not there, or no file that can be used.
    """
    from render.shapes import load
    from render.shapes.own_meshes import name_of

    files = mesh_files(family)
    names: dict[str, str] = {}  # by content
    reasons = []
    order = generator(seed, OWN_MESHES, "order").permutation(len(files))
    with progress_bar(total=min(count, len(files)), desc="meshes", unit="file", leave=False) as bar:
        for path in (files[index] for index in order):
            if len(names) == count:
                break
            try:
                name = name_of(path, family.up)
                content = name.split(":", 3)[2]
                if content in names:
                    raise InputError(f"{path}: a copy of {names[content].split(':', 3)[3]}")
                load(name)
            except InputError as error:
                reasons.append(str(error))
                _log.warning("skipped %s", error)
                continue
            names[content] = name
            bar.update()
    if not names:
        raise InputError(f"meshes.path: none of {len(files)} mesh files can be used; the first one: {reasons[0]}")
    return list(names.values())


def mesh_files(family: MeshFamily) -> list[Path]:
    """List the mesh files of a family by name, each once.

    Raises:
        InputError: a path that is not there, or a folder without mesh files.
    """
    found: dict[Path, Path] = {}
    for text in family.path:
        path = Path(text)
        if not path.exists():
            raise InputError(f"meshes.path: {path}: no such file or folder (looked for at {path.absolute()})")
        inside = [path] if path.is_file() else sorted(_in_folder(path))
        if not inside:
            raise InputError(f"meshes.path: {path}: holds no mesh file such as .obj, .ply, .stl or .glb")
        for file in inside:
            found.setdefault(file.resolve(), file)
    return sorted(found.values())


def _in_folder(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder whose endings are those of meshes; other files, such as textures, are left out."""
    from trimesh.exchange.load import mesh_formats

    formats = mesh_formats() - {"xyz"}  # points alone
    for path in folder.rglob("*"):
        name = Path(path.stem) if path.suffix.lower() == ".gz" else path
        if name.suffix[1:].lower() in formats and not path.name.startswith(".") and path.is_file():
            yield path
