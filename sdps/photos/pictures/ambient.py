"""What is in every photograph without coming from the lamp: the room's light and the sensor's offset.

Legend: L photographs of H x W pixels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from render.shared.errors import InputError, list_names

NONE = "none"
"""In place of a file: nothing is subtracted."""

_SAME_EXPOSURE = 0.01
"""Relative difference of exposures that are taken for equal; EXIF rounds times and f-numbers."""


@dataclass(frozen=True, eq=False)
class Background:
    """What is taken off every photograph, in linear radiance, full scale = 1.

    A photograph is I = D + g (A - D) + what the lamp adds: dark frame D, ambient picture A, and g, its exposure over
    that of A. With g = 1 the dark frame cancels.

    Attributes:
        ambient: (H, W, 3) float32, A or, with a dark frame, A - D; None without an ambient picture.
        dark: (H, W, 3) float32, D; None without.
        gains: g by the file's name; 1 for files that are not in it.
    """

    ambient: np.ndarray | None = None
    dark: np.ndarray | None = None
    gains: Mapping[str, float] = field(default_factory=dict)

    def subtract(self, image: np.ndarray, name: str, part: tuple[slice, slice], saturation: float) -> None:
        """Take it off (h, w, 3) float32 in place; what falls below 0 becomes 0.

        A value of at least `saturation` stays as it is: the lamp's part of it is not known, and those who look for
        clipped values find it.

        Args:
            image: Rows and columns `part` of the photograph.
            name: Its file's.
            part: Rows and columns.
            saturation: Linear value from which on a pixel is clipped.
        """
        for channel in range(3):  # one by one, for memory
            values = image[..., channel]
            offset = np.zeros(values.shape, np.float32)
            if self.ambient is not None:
                offset += np.float32(self.gains.get(name, 1.0)) * self.ambient[(*part, channel)]
            if self.dark is not None:
                offset += self.dark[(*part, channel)]
            np.copyto(values, np.maximum(values - offset, 0.0), where=values < saturation)


@dataclass(frozen=True)
class Frames:
    """Pictures without the lamp.

    Attributes:
        what: What they are, with the article.
        paths: The files.
        asked: What the user named; None where their names say what they are.
    """

    what: str
    paths: tuple[Path, ...]
    asked: str | Path | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture without the lamp as it was read.

    Attributes:
        linear: (H, W, 3) float32, linear radiance; None where it does not fit the photographs.
        exposure: As EXIF data say, 0 where they do not.
        unfit: Why it does not fit, after its name; empty where it does.
    """

    linear: np.ndarray | None
    exposure: float
    unfit: str = ""


def find_frames(folder: Path, asked: str | Path | None, flag: str, what: str, named: Sequence[str]) -> Frames:
    """Return the pictures that `flag` names or, if `asked` is None, those of the folder that are `named` so.

    Raises:
        InputError: no such picture.
    """
    if asked is None:
        return Frames(what, tuple(folder / name for name in named))
    if str(asked) == NONE:
        return Frames(what, (), asked)
    found = next((path for path in (Path(asked), folder / asked) if path.is_file()), None)
    if found is None:
        raise InputError(f"{flag} {asked}: no such picture; name the file, or {NONE} to subtract nothing")
    return Frames(what, (found,), asked)


def read_background(
    ambient: Frames, dark: Frames, read: Callable[[Path], Frame], exposures: Mapping[str, float]
) -> tuple[Background | None, list[str]]:
    """Read what is subtracted of every photograph, and say what it is.

    Args:
        ambient: Pictures of the room's light.
        dark: Pictures with the lens covered.
        read: Reads one of them as the photographs are read.
        exposures: Of the photographs by name, 0 where they do not say.

    Raises:
        InputError: a file that was asked for and does not fit the photographs.
    """
    notes: list[str] = []
    (offset, offsets), (light, lights) = (_average(frames, read, notes) for frames in (dark, ambient))
    gains, said = _find_gains(exposures, lights) if lights else ({}, "")
    for frames, found, more in ((ambient, lights, said), (dark, offsets, "")):
        if found:
            verb = f"{'was' if len(found) == 1 else 'were'} subtracted, as {frames.what}"
            notes.append(f"{list_names(list(found))} {verb}{f' ({more})' if more else ''}")
    if light is not None and offset is not None:
        light -= offset
    return None if light is None and offset is None else Background(light, offset, gains), notes


def _average(
    frames: Frames, read: Callable[[Path], Frame], notes: list[str]
) -> tuple[np.ndarray | None, dict[str, float]]:
    """Return the mean of the pictures that fit, (H, W, 3) float32 linear, and their exposures by name."""
    total, exposures = None, {}
    for path in frames.paths:
        frame = read(path)
        if frame.linear is None and frames.asked is not None:
            remedy = f"{frames.what} must be taken as the photographs are, without the lamp"
            raise InputError(f"{path}: {frame.unfit}; {remedy}")
        if frame.linear is None:
            notes.append(f"left out: {path.name} ({frames.what} by name, but it {frame.unfit})")
            continue
        total = frame.linear if total is None else total + frame.linear
        exposures[path.name] = frame.exposure
    return (None, {}) if total is None else (total / np.float32(len(exposures)), exposures)


def _find_gains(exposures: Mapping[str, float], lights: Mapping[str, float]) -> tuple[dict[str, float], str]:
    """Return each photograph's exposure over that of the ambient pictures, and what is said of it.

    Args:
        exposures: Of the photographs by name, 0 where a file does not say.
        lights: The same of the ambient pictures.
    """
    known = [*exposures.values(), *lights.values()]
    if not all(known):
        return {}, "not all pictures say their exposure, so it is taken for the same" if any(known) else ""
    first = next(iter(lights.values()))
    if any(abs(one / first - 1.0) > _SAME_EXPOSURE for one in lights.values()):
        return {}, "their exposures differ, so these are taken for those of the photographs"
    gains = {name: one / first for name, one in exposures.items()}
    low, high = min(gains.values()), max(gains.values())
    if max(abs(low - 1.0), abs(high - 1.0)) <= _SAME_EXPOSURE:
        return {}, ""
    times = f"{low:.3g}" if high - low <= _SAME_EXPOSURE * high else f"{low:.3g} to {high:.3g}"
    return gains, f"times {times}, the ratio of the exposures in the EXIF data"
