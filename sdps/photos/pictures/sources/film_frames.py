"""Films: of a lamp that moves while the camera stands still, some frames are photographs.

Decoded values are those of a display, 8-bit sRGB, turned as the film's rotation says.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from render.shared.decoding import decoding, silence
from render.shared.errors import InputError
from render.shared.progress import progress_bar
from sdps.photos.pictures.picture_kinds import FILMS

FLAG = "--every"
ABOUT = 60
"""Frames that are kept unless the user says how many."""

MOST = 1000
_FEWEST = 3
_MOST_PIXELS = 50_000_000  # of a frame
_SAME = 0.01
"""Root mean square of the difference from the frame before, as a share of the picture's, below which the lamp has not
moved; on pictures reduced to some thousand pixels, where the noise of the coding is averaged away."""

_BLURRED = 0.5
"""Sharpness below which a frame is blurred, as a share of the median of all."""

_SMALL, _SIDE = 80, 640
"""Longer sides of the pictures in which frames are compared, and their sharpness is measured: with strong noise, frames
of 1920x1080 pixels that are blurred by 6 have 0.2 to 0.3 of the median, the others 0.98 to 1.03."""

_NAMED = 8
_REMEDY = "convert it to an MP4 file (H.264), or save its frames as PNG files"


@dataclass
class _Left:
    """Frames that are not used, by the reason."""

    same: list[int] = field(default_factory=list)
    blurred: list[int] = field(default_factory=list)

    def describe(self) -> list[str]:
        """Return a note, or none where all frames are used."""
        parts = [(self.same, "as the one before"), (self.blurred, "blurred")]
        said = [f"{_join(numbers)} ({why})" for numbers, why in parts if numbers]
        return [f"left out of the film's frames: {', '.join(said)}"] if said else []


def is_film(path: Path) -> bool:
    """Tell whether a file is a film by its name."""
    return path.suffix.lower() in FILMS


def check_every(every: int | None) -> None:
    """Refuse a number of frames that is none.

    Raises:
        InputError: less than 1.
    """
    if every is not None and every < 1:
        raise InputError(f"{FLAG} {every}: must be at least 1; {FLAG} 10 takes every tenth frame of a film")


def take_frames(path: Path, folder: Path, every: int | None = None) -> tuple[str, ...]:
    """Write frames of a film into a new folder as frame-0000.png, ..., numbered from 0 as in the film.

    One frame at a time is held in memory. Of those that are looked at, one as the one before it and one that is blurred
    are left out.

    Args:
        path: The film.
        folder: To be made.
        every: Look at every n-th frame; None: so that about 60 are looked at.

    Returns:
        Notes: how many frames were taken, and which were not.

    Raises:
        InputError: no film that can be decoded, too many or too few frames, too large ones, or a full disk.
    """
    check_every(every)
    folder.mkdir()
    with _open(path) as film:
        count = _count(path, film)
        every = every or max(1, round(count / ABOUT))
        width, height = (int(film.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        _check_room(path, folder, (width, height), -(-count // every), every)
        left, sharpness = _Left(), {}
        before: np.ndarray | None = None
        digits = max(4, len(str(count)))
        for number, frame in _frames(film, count, every):
            small = _reduce(frame, _SMALL)
            if before is not None and _is_same(small, before):
                left.same.append(number)
                continue
            before = small
            sharpness[number] = _measure_sharpness(frame)
            _write(folder / _name(number, digits), frame)
    limit = _BLURRED * float(np.median([*sharpness.values()] or [0.0]))
    left.blurred = [number for number, value in sharpness.items() if value < limit]
    for number in left.blurred:
        (folder / _name(number, digits)).unlink()
    kept = len(sharpness) - len(left.blurred)
    if kept < _FEWEST:
        raise InputError(
            f"{path}: only {kept} of its {count} frames {'is' if kept == 1 else 'are'} sharp and not as the one before;"
            " the lamp must move while the camera films"
        )
    which = "every frame" if every == 1 else f"one of every {every} frames"
    taken = f"{path.name} has {count:,} frames; {which} was looked at, and {kept} are the photographs"
    return (taken, *left.describe())


@contextmanager
def _open(path: Path) -> Iterator[cv2.VideoCapture]:
    """Open a film.

    Raises:
        InputError: missing, or nothing that OpenCV decodes.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such film; give the folder that holds the photographs, or a film")
    with silence(), decoding(path, "a film", _REMEDY):
        film = cv2.VideoCapture(str(path))
        try:
            if not film.isOpened():
                raise InputError(f"{path}: damaged or not a film that can be decoded; {_REMEDY}")
            yield film
        finally:
            film.release()


def _count(path: Path, film: cv2.VideoCapture) -> int:
    """Return the number of frames, as the film says or, where it does not, counted."""
    count = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
    if count <= 0:
        count = 0
        while film.grab():
            count += 1
        film.release()
        film.open(str(path))
    if count <= 0:
        raise InputError(f"{path}: damaged, no frame can be decoded; {_REMEDY}")
    return count


def _check_room(path: Path, folder: Path, size: tuple[int, int], count: int, every: int) -> None:
    """Refuse frames that are too many or too large."""
    pixels = size[0] * size[1]
    if pixels > _MOST_PIXELS:
        raise InputError(f"{path}: its frames are {size[0]}x{size[1]} pixels; make them smaller")
    if count > MOST:
        raise InputError(f"{path}: {FLAG} {every} takes {count:,} frames, more than {MOST:,}; give a larger number")
    if 3 * pixels * count > shutil.disk_usage(folder).free:
        raise InputError(
            f"{path}: its frames may take {3 * pixels * count / 2**30:.1f} GiB in {folder.parent}; take fewer ({FLAG} "
            f"{2 * every}), free some space, or set TMPDIR"
        )


def _frames(film: cv2.VideoCapture, count: int, every: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield every n-th frame, (H, W, 3) uint8 BGR, with its number."""
    for number in progress_bar(range(count), desc="film", unit="frame", delay=5):
        if not film.grab():
            return  # the film said more frames than it has
        if number % every == 0:
            there, frame = film.retrieve()
            if there:
                yield number, frame


def _reduce(frame: np.ndarray, side: int) -> np.ndarray:
    """Return the brightness of a frame, reduced to at most so many pixels on its longer side, float32."""
    scale = min(1.0, side / max(frame.shape[:2]))
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return small.astype(np.float32)


def _is_same(small: np.ndarray, before: np.ndarray) -> bool:
    difference = float(np.sqrt(np.mean((small - before) ** 2)))
    return difference < _SAME * max(float(np.sqrt(np.mean(before**2))), 1.0)


def _measure_sharpness(frame: np.ndarray) -> float:
    """Return how much of a frame's detail is fine: that of its Laplacian over that of the blurred frame's.

    The light changes both alike, movement and bad focus only the former. Reduced pictures and linear values keep the
    noise of dark parts out of it.
    """
    grey = _reduce(frame, _SIDE) / 255
    linear = grey**2.2
    fine, coarse = (cv2.Laplacian(one, cv2.CV_32F).var() for one in (linear, cv2.GaussianBlur(linear, (0, 0), 2.0)))
    return float(fine) / max(float(coarse), 1e-9)


def _name(number: int, digits: int) -> str:
    return f"frame-{number:0{digits}d}.png"


def _write(path: Path, frame: np.ndarray) -> None:
    if not cv2.imwrite(str(path), frame, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise InputError(f"{path}: cannot be written; free some space, or set TMPDIR")


def _join(numbers: list[int]) -> str:
    """Name frames by their numbers, of many the first and how many there are."""
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return ", ".join(map(str, numbers[:_NAMED])) + more
