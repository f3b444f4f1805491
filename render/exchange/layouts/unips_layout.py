"""UniPS and SDM-UniPS test folders, which have no file for lights: scene.json holds them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from render.exchange.layouts.foreign_samples import MARKER, Source, read_painted_truth, read_record
from render.exchange.layouts.layout_base import Layout, Sample, image_names
from render.shared.errors import InputError
from render.shared.tables import natural_key


class UniPs(Layout):
    """A folder `<object>.data` per object, with L*.png, mask.png and Normal_gt.png."""

    about = "UniPS / SDM-UniPS test folder"
    folder_pattern = "{}.data"
    directions = False

    def write(self, folder: Path, final: Path, sample: Sample) -> None:
        sample.write_images(folder, image_names(len(sample.pixels), "L{:03d}.png"))
        sample.write_truth(folder, "Normal_gt.png")

    def list_samples(self, tree: Path) -> Sequence[Callable[[], Source]]:
        folders = sorted(tree.glob("*.data"), key=lambda path: natural_key(path.name))
        if not folders:
            raise InputError(f"{tree}: no <object>.data folder; give the folder that holds them")
        return [partial(_read_object, folder) for folder in folders]


def _read_object(folder: Path) -> Source:
    """List the images as the loader does, by a plain sort, and read their lights where our export left them."""
    names = sorted(path.name for path in folder.glob("L*") if not path.name.endswith(".txt"))
    if not names:
        raise InputError(f"{folder}: no L*.png; name the images L000.png, L001.png, ...")
    directions, intensities = np.zeros((0, 3)), np.ones((len(names), 3))
    marker = read_record(folder / MARKER) if (folder / MARKER).is_file() else {}
    if "light_directions" in marker:  # mixed light has none
        directions = np.asarray(marker["light_directions"], np.float64)
        intensities = np.repeat(np.asarray(marker["light_intensities"], np.float64)[:, None], 3, 1)
        if names != sorted(names, key=natural_key) or len(directions) != len(names):
            raise InputError(f"{folder}: L*.png do not match the lights of {MARKER}; export the object again")
    truth = partial(read_painted_truth, folder, "Normal_gt.png")
    return Source.of_object(folder, ".data", names, (directions, intensities), truth)
