"""SDPS-Net's UPS_Custom_Dataset: images with a mask; lights and normals are optional."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from render.exchange.layouts.foreign_samples import Note, Source, Truth, read_lights, read_painted_truth
from render.exchange.layouts.layout_base import Layout, Sample, image_names, write_lines
from render.records.manifest import SceneSpec
from render.shared.files import write_text
from render.shared.tables import lines_text, natural_key, read_names


class Custom(Layout):
    """A folder per object; objects.txt names them."""

    about = "SDPS-Net's UPS_Custom_Dataset folder"
    bits = (8, 16)

    def write(self, folder: Path, final: Path, sample: Sample) -> None:
        names = image_names(len(sample.pixels))
        sample.write_images(folder, names)
        write_lines(folder / "names.txt", names)
        sample.write_lights(folder)
        sample.write_truth(folder, "normal.png")

    def write_lists(self, root: Path, placed: Sequence[tuple[SceneSpec, str]]) -> None:
        write_text(root / "objects.txt", lines_text([folder for _, folder in placed]))

    def list_samples(self, tree: Path) -> Sequence[Callable[[], Source]]:
        return [partial(_read_object, tree / name) for name in read_names(tree / "objects.txt")]

    def check_sample(self, source: Source, truth: Truth, bits: int, note: Note) -> None:
        if list(source.images) != sorted(source.images, key=natural_key):
            note(
                f"{source.folder / 'names.txt'}: not in natural order; the loader sorts it, but not the lights: sort "
                "both alike"
            )


def _read_object(folder: Path) -> Source:
    """Read the text files of one object."""
    names = read_names(folder / "names.txt")
    lights = read_lights(folder, len(names), optional=True)
    return Source.of_object(folder, "", names, lights, lambda: read_painted_truth(folder, "normal.png"))
