"""Which lights are known of a folder of photographs: directions, intensities, both or neither."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from sdps.photos.light_files import FaultHandler, find_lights, read_intensities, read_lights
from sdps.photos.light_files.light_frame import frame_matrix

EQUAL = "equal"
"""In place of a file of intensities: the user knows that all lights are equally strong."""
_USUAL, _PARTNER = ("lights.json", "light_directions.txt"), "light_intensities.txt"


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownLights:
    """What is known of the lights before the photographs are looked at.

    Attributes:
        directions: (L, 3) float32, unit, x right, y up, z to the camera, from the surface to the light; or None.
        intensities: (L,) or (L, 3) float32, relative; or None.
        name: Name of the file of the directions; empty without one.
        frame: The frame flag it was read with; empty where the file states its own frame.
        notes: Plain sentences about where they come from.
        distances: (L,) float64, of the lamps from the object's middle, in `unit`; None where the file has none.
        unit: mm, cm, m, pixels, or objects: sizes of the object.
        image_width: Millimetres that the pictures' whole width shows; 0 where no file says.
    """

    directions: np.ndarray | None = None
    intensities: np.ndarray | None = None
    name: str = ""
    frame: str = ""
    notes: tuple[str, ...] = ("lights are unknown and will be estimated, where the method can",)
    distances: np.ndarray | None = None
    unit: str = ""
    image_width: float = 0.0


def known_lights(
    folders: Sequence[Path],
    files: Sequence[str],
    lights: str | Path | None,
    intensities: str | Path | None,
    frame: str,
    stops: FaultHandler,
) -> KnownLights:
    """Read directions and intensities where asked for; a frame flag without lights is checked all the same.

    Args:
        folders: Where the photographs and what goes with them may lie, the first first.
        files: Their names, (L,).
        lights: A file, `folder` for what lies there, or None.
        intensities: A file, `folder`, `equal`, or None for those of the file of lights or of the light_intensities.txt
            that lies with a light_directions.txt.
        frame: Axes of the file of lights.
        stops: What becomes of lights that are not above the horizon.

    Raises:
        InputError: a file that is missing or cannot be used, or intensities in two files.
    """
    frame_matrix(frame)
    lying = next(filter(None, map(find_lights, folders)), lights) if str(lights) == "folder" else lights
    path = _resolve(folders, lying, _USUAL)
    directions = strengths = None
    name, notes, found = "", KnownLights.notes, KnownLights()
    if path is not None:
        read = read_lights(path, files, frame, stops)
        directions, strengths, notes, name = read.directions, read.intensities, read.notes, path.name
        found = KnownLights(
            directions=directions, name=name, frame="" if read.own_frame else frame, distances=read.distances,
            unit=read.unit, image_width=read.image_width,
        )  # fmt: skip
    if intensities is not None and str(intensities) == EQUAL:
        strengths, notes = np.ones(len(files), np.float32), (*notes, "intensities are taken for equal, as asked")
        return replace(found, intensities=strengths, notes=notes)
    second = _resolve(folders, intensities, (_PARTNER,))
    partner = None if path is None else path.with_name(_PARTNER)
    if second is None and path is not None and path.name == _USUAL[1] and partner is not None and partner.is_file():
        second = partner
    if second is not None:
        if strengths is not None:
            raise InputError(f"{second}: {name} holds intensities as well; keep those of one file")
        strengths = read_intensities(second, files)
        notes = (*notes, f"intensities are those of {second.name}")
    elif directions is not None and strengths is None:
        notes = (*notes, f"{name} has no intensities; a network finds them (--intensities {EQUAL} if all lights are)")
    return replace(found, intensities=strengths, notes=notes)


def _resolve(folders: Sequence[Path], asked: str | Path | None, known: tuple[str, ...]) -> Path | None:
    """Resolve `folder` to the first known file of the folders."""
    if asked is None or str(asked) != "folder":
        return None if asked is None else Path(asked)
    found = next((folder / name for folder in folders for name in known if (folder / name).is_file()), None)
    if found is None:
        raise InputError(f"{folders[0]}: no {' or '.join(known)} in it; give the file's path")
    return found
