"""What the user says of balls: where they are, of which kind, and in which folder."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.errors import InputError, unknown
from sdps.photos.analysis.balls.ball_spheres import Circle

FLAG, RADIUS_FLAG = "--ball", "--ball-radius"
AUTO = "auto"
CHROME, WHITE = "chrome", "white"

_SMALLEST = 3.0  # radius in pixels
_REMEDY = "write x,y,radius in pixels of the files, auto, or a folder with pictures of the ball"
_CIRCLE = re.compile(r"(?:(.*):)?\s*([^:,]+),([^:,]+),([^:,]+)\s*", re.DOTALL)

Said = str | Path | Sequence[float]
"""One ball, as a flag says it, or as three numbers."""


@dataclass(frozen=True)
class WantedBall:
    """One ball, or those that are to be found.

    Attributes:
        circle: Its outline in pixels of the files; None: to be found.
        kind: `chrome` or `white`; empty: as the pictures tell.
        folder: Where it is photographed alone under the same lights; None: in the pictures of the object.
        millimetres: Its real radius; None: not known.
    """

    circle: Circle | None = None
    kind: str = ""
    folder: Path | None = None
    millimetres: float | None = None


def read_balls(said: Said | Iterable[Said] | None, lights: str | Path | None = None) -> tuple[WantedBall, ...]:
    """Read `x,y,radius`, `auto`, a folder, or `folder:x,y,radius`, each with `chrome:` or `white:` before it or not.

    Args:
        said: One ball or several; a ball in the pictures may be three numbers.
        lights: Other lights, which may not be given as well.

    Raises:
        InputError: something else, a radius under 3 pixels, or two kinds of lights.
    """
    every: list[Any] = [said] if isinstance(said, str | Path) else list(said or ())
    if every and all(isinstance(one, int | float) for one in every):
        every = [every]
    if every and lights is not None:
        raise InputError(f"{FLAG}: the lights are those of --lights {lights}; keep one of the two")
    return tuple(map(_read, every))


def measure_balls(balls: Sequence[WantedBall], said: str | float | Sequence[float] | None) -> tuple[WantedBall, ...]:
    """Return balls with their real radii.

    Args:
        balls: Of `read_balls`.
        said: Millimetres: one number for all, or one for each, joined by commas in a text; None: not known.

    Raises:
        InputError: no balls, another number of radii, or one that is not above 0.
    """
    if said is None:
        return tuple(balls)
    words = said.split(",") if isinstance(said, str) else np.ravel(said).tolist()
    try:
        radii = [float(word) for word in words]
    except (TypeError, ValueError):
        radii = [-1.0]
    if not radii or not all(0.0 < radius < np.inf for radius in radii):
        raise InputError(
            f"{RADIUS_FLAG} {said}: must be millimetres above 0; one number, or one for each ball: 10,12.5"
        )
    if not balls:
        raise InputError(f"{RADIUS_FLAG} {said}: no ball is given; add {FLAG} auto, or {FLAG} x,y,radius")
    if len(radii) not in (1, len(balls)):
        raise InputError(
            f"{RADIUS_FLAG} {said}: {len(radii)} radii for {len(balls)} of {FLAG}; give one, or one for each"
        )
    every = radii * len(balls) if len(radii) == 1 else radii
    return tuple(replace(ball, millimetres=radius) for ball, radius in zip(balls, every, strict=True))


def _read(said: Said) -> WantedBall:
    text = str(said) if isinstance(said, str | Path) else ",".join(map(str, said))
    kind, rest = "", text.strip()
    for known in (CHROME, WHITE):
        if rest.startswith(f"{known}:"):
            kind, rest = known, rest[len(known) + 1 :]
    if rest == AUTO or (kind and not rest):
        return WantedBall(kind=kind)
    if rest and Path(rest).is_dir():
        return WantedBall(kind=kind, folder=Path(rest))
    found = _CIRCLE.fullmatch(rest)
    circle = None if found is None else _read_circle(found.groups()[1:])
    if found is None or circle is None:
        if re.search(r"[/\\.]", rest):
            raise InputError(f"{FLAG} {text}: no such folder; {_REMEDY}")
        raise unknown(FLAG, rest, (AUTO, f"{CHROME}:{AUTO}", f"{WHITE}:{AUTO}"), _REMEDY)
    if not circle.radius >= _SMALLEST:
        raise InputError(f"{FLAG} {text}: the radius must be at least {_SMALLEST:g} pixels; {_REMEDY}")
    place = found[1]
    if place and not Path(place).is_dir():
        raise InputError(f"{FLAG} {text}: no such folder: {place}; {_REMEDY}")
    return WantedBall(circle, kind, Path(place) if place else None)


def _read_circle(words: Sequence[str]) -> Circle | None:
    try:
        x, y, radius = map(float, words)
    except ValueError:
        return None
    return Circle(x, y, radius) if np.isfinite([x, y, radius]).all() else None
