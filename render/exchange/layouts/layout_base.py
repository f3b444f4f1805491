"""What every exchange layout has: names, pictures of one scene, lists of the whole tree, and what its loaders demand.

A layout is a class below `Layout` in a module of its own, and a line of `render.exchange.layouts.LAYOUTS`.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from render.exchange.layouts.foreign_samples import Note, Source, Truth
from render.records.manifest import SceneSpec
from render.shared.images import encode_normals, write_png
from render.shared.tables import format_rows, lines_text

_LONGEST = 80
_MATERIAL_FILES = r"\.(ya?ml|binary|bsdf)(?=\+|$)"


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

    def write_images(self, folder: Path, names: Sequence[str]) -> None:
        """Write the images under these names."""
        for name, pixels in zip(names, self.pixels, strict=True):
            write_png(folder / name, pixels)

    def write_lights(self, folder: Path) -> None:
        """Write light_directions.txt and light_intensities.txt; loaders demand three columns of our white lights."""
        write_lines(folder / "light_directions.txt", format_rows(self.directions))
        write_lines(folder / "light_intensities.txt", format_rows(np.repeat(self.intensities[:, None], 3, axis=1)))

    def write_truth(self, folder: Path, normals_name: str) -> None:
        """Write mask.png and the normal map."""
        write_png(folder / "mask.png", self.mask.astype(np.uint8) * 255)
        write_png(folder / normals_name, encode_normals(self.normals))


class Layout:
    """How scenes lie in a tree; the methods are the hooks a layout overrides where it differs.

    Attributes:
        about: One line for `--help`.
        folder_pattern: Folder of a scene below the root, `{}` for its name.
        bits: Depths its loaders read correctly; the first is the default.
        exposure: Default exposure.
        intensities: Whether images may have other than unit intensity.
        directions: Whether a file of its own holds the direction of each image's light.
        importable: Whether its trees have all that a data folder needs.
        crop: Pixels that its trainers crop pictures to by default; 0 where they do not.
    """

    about: str
    folder_pattern: str = "{}"
    bits: tuple[int, ...] = (16, 8)
    exposure: float | str = "auto"
    intensities: bool = True
    directions: bool = True
    importable: bool = False
    crop: int = 0

    def name_folders(self, scenes: Sequence[SceneSpec]) -> dict[str, str]:
        """Return the folder of each scene of a manifest, relative to the root, by the scene's id.

        Names are given to the whole manifest at once, so that exporting some scenes first and the others later ends in
        the same tree.
        """
        names = unique_names([legal_name(scene.id) for scene in scenes])
        return {scene.id: self.folder_pattern.format(name) for scene, name in zip(scenes, names, strict=True)}

    def check_lights(self, counts: set[int], folder: Path) -> None:
        """Refuse numbers of lights that the layout cannot hold with an InputError."""

    def write(self, folder: Path, final: Path, sample: Sample) -> None:
        """Write one scene into the empty `folder`, which becomes `final`."""
        raise NotImplementedError

    def write_lists(self, root: Path, placed: Sequence[tuple[SceneSpec, str]]) -> None:
        """Write the files that name the scenes; gets them with their folders, in the manifest's order."""

    def describe_gaps(self, splits: set[str]) -> str:
        """Say what an exported tree with scenes of these splits still lacks; empty where it lacks nothing."""
        return ""

    def list_samples(self, tree: Path) -> Sequence[Callable[[], Source]]:
        """List the samples of a tree, each as a function that reads its text files.

        Raises:
            InputError: not such a tree, or a list that its loaders would misread; the functions too raise it.
        """
        raise NotImplementedError

    def check_lists(self, tree: Path, sources: Sequence[Source], note: Note) -> None:
        """Note what loaders would miss or misread in the files that name the samples."""

    def check_sample(self, source: Source, truth: Truth, bits: int, note: Note) -> None:
        """Note what loaders would misread in the files of one sample, whose images have `bits` per channel."""


def legal_name(name: str) -> str:
    """Turn a scene id, shape or material name into a file name; of paths only the stem of the file is kept.

    What is left, ASCII letters, digits and hyphens, has no separator, comment or blank, sorts alike in every natural
    order, and stays apart on file systems that ignore case (`unique_names`).
    """
    stem = re.sub(_MATERIAL_FILES, "", re.sub(r"[^:+]*[/\\]", "", name))
    return re.sub(r"[^A-Za-z0-9]+", "-", stem).strip("-")[:_LONGEST].strip("-") or "unnamed"


def unique_names(names: Sequence[str]) -> list[str]:
    """Number those names that are equal but for case: `a`, `b`, `A` becomes `a-1`, `b`, `A-2`."""
    counts = Counter(name.casefold() for name in names)
    taken = {name for name, count in counts.items() if count == 1}
    result = []
    for name in names:
        chosen, number = name, 0
        while counts[name.casefold()] > 1 and (number == 0 or chosen.casefold() in taken):
            number += 1
            chosen = f"{name}-{number}"
        taken.add(chosen.casefold())
        result.append(chosen)
    return result


def image_names(count: int, pattern: str = "{:03d}.png", first: int = 0) -> list[str]:
    """Return names with equally many digits, so that every kind of sorting keeps the order of the lights."""
    width = len(str(first + count - 1))
    return [pattern.replace("03d", f"0{max(3, width)}d").format(first + number) for number in range(count)]


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a text file into a folder that is still temporary."""
    path.write_text(lines_text(lines), encoding="utf-8", newline="\n")
