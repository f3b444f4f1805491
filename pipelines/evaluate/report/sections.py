"""Sections of a report: what one evaluation shows, as data on disk, so that a page can be made of all of them.

An evaluation writes its section into `<out>/report/<name>/`: `section.json` and its pictures. `sdps evaluate
report` collects the sections under a folder into one self-contained page.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from render.shared.config import build, to_plain
from render.shared.errors import InputError
from render.shared.files import atomic_folder, is_plain_name, read_json, write_json
from render.shared.temporary import tidy

FOLDER = "report"
_FILE = "section.json"
_LARGE = 2**20  # pixels of a picture
KINDS = ("", "normals", "truth", "beside")


class Tile(NamedTuple):
    """A picture of a row, (H, W, 3) uint8 or a figure, its caption, and its kind (`Picture.kind`)."""

    caption: str
    picture: np.ndarray | Image.Image | Figure
    kind: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of text cells.

    Attributes:
        title: Its caption.
        header: Column names.
        rows: Cells.
        published: Numbers of the rows that hold published figures only.
        prose: Numbers of the columns that hold sentences, which wrap.
        note: A sentence below it: what the numbers are of (mask, bit depth, images, crop).
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    published: tuple[int, ...] = ()
    prose: tuple[int, ...] = ()
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture with its caption.

    Attributes:
        caption: What it shows; also its alternative text.
        file: Its file in the section's folder.
        wide: A chart or sheet, shown at its own width rather than as a tile of a strip.
        kind: What the page can do with it: `normals` and `truth` are maps of normals, found and true; `beside` is of
            the same pixels; empty for all else.
    """

    caption: str
    file: str
    wide: bool = False
    kind: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"kind: {self.kind!r} is not one of {', '.join(filter(None, KINDS))}")
        if not is_plain_name(self.file):
            raise InputError(f"file: {self.file!r} is not the name of a picture in the section's folder")


@dataclass(frozen=True, kw_only=True)
class Strip:
    """Pictures that belong together, such as input, normals, error and lights of one object.

    Attributes:
        title: What they show.
        pictures: From left to right.
    """

    title: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, kw_only=True)
class Section:
    """What one evaluation shows.

    Attributes:
        name: Folder name, unique within a report.
        title: Heading.
        text: A paragraph: what was evaluated, and how the numbers are defined.
        alert: A sentence above it that a reader must not miss.
        order: Sections are shown in rising order.
        tables: Tables.
        strips: Rows of pictures.
        pictures_first: Pictures stand above the tables.
        command: The command that makes it again.
    """

    name: str
    title: str
    text: str
    alert: str = ""
    order: int = 100
    tables: tuple[Table, ...] = ()
    strips: tuple[Strip, ...] = ()
    pictures_first: bool = False
    command: str = ""


class SectionWriter:
    """Gathers a section's pictures and writes them with it.

    Args:
        section: The section; strips added here are appended to its own.
    """

    def __init__(self, section: Section) -> None:
        self.section = section
        self._strips: list[Strip] = []
        self._pictures: dict[str, np.ndarray | Image.Image | Figure] = {}

    def strip(
        self, title: str, tiles: Sequence[Tile | tuple[str, np.ndarray | Image.Image | Figure]], *, wide: bool = False
    ) -> None:
        """Add a row of tiles, or of (caption, picture); arrays are (H, W, 3) uint8."""
        pictures = []
        for caption, picture, kind in (Tile(*tile) for tile in tiles):
            name = f"{len(self._pictures):03d}.png"
            self._pictures[name] = picture
            pictures.append(Picture(caption=caption, file=name, wide=wide, kind=kind))
        self._strips.append(Strip(title=title, pictures=tuple(pictures)))

    def write(self, out: Path) -> Path:
        """Write the section whole, in place of an earlier one, and return its folder.

        Raises:
            InputError: the folder cannot be written.
        """
        section = replace(self.section, strips=(*self.section.strips, *self._strips))
        folder = out / FOLDER / section.name
        with atomic_folder(folder) as temporary:
            for name, picture in self._pictures.items():
                save_picture(picture, temporary / name)
            write_json(temporary / _FILE, to_plain(section))
        return folder


def save_picture(picture: np.ndarray | Image.Image | Figure, path: Path) -> None:
    """Write an array (H, W, 3) uint8, an image or a figure as PNG."""
    if isinstance(picture, Figure):
        picture.savefig(path, format="png", dpi=130)
        return
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    image.save(path, format="png", optimize=image.width * image.height < _LARGE)  # which takes seconds of large ones


def read_sections(out: Path) -> list[tuple[Path, Section]]:
    """Return the sections under a folder with theirs, in the order of showing.

    Raises:
        InputError: a section that is damaged.
    """
    tidy(out / FOLDER)  # a run may have been killed while it replaced a section
    found = [(path.parent, _read(path)) for path in sorted((out / FOLDER).glob(f"[!.]*/{_FILE}"))]
    return sorted(found, key=lambda item: (item[1].order, item[1].name))


def _read(path: Path) -> Section:
    again = "run the evaluation that wrote it again"
    values = read_json(path, again)
    try:
        return build(Section, values)
    except InputError as error:
        raise InputError(f"{path}: {error}; {again}") from error
