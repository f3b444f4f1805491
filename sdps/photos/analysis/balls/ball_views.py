"""What the pictures show of balls: the window around each, and how well Lambert's law explains it as a white ball."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from render.shared.progress import progress_bar
from sdps.photos.analysis.balls.ball_spheres import Sphere

_LARGEST = 200  # radius in pixels of what is kept; larger balls are reduced
_RIM = 0.95  # in radii: beyond it a pixel may hold background
_LIT = 0.15  # cosine under which a pixel may lie in the ball's own shadow
_ROUNDS = 6
_FEWEST, _PIXELS = 20, 5000  # that Lambert's law is fitted to


class Pictures(Protocol):
    """Linear radiance (L, H, W, 3) that is read on demand: `sdps.photos.Photographs`."""

    def __len__(self) -> int: ...

    def window(self, part: slice, rows: slice, columns: slice) -> np.ndarray:
        """Return rows and columns of some pictures."""


@dataclass(frozen=True, eq=False)
class BallView:
    """A ball in all pictures.

    Attributes:
        sphere: It.
        rows, columns: (h, w) of the picture, where the window's pixels have their middles.
        colours: (L, h, w, 3) float32, radiance.
        clipped: (L, h, w) bool, some channel is saturated.
        outlined: Share of the ball's outline that is seen.
    """

    sphere: Sphere
    rows: np.ndarray
    columns: np.ndarray
    colours: np.ndarray
    clipped: np.ndarray
    outlined: float = 1.0

    @cached_property
    def grey(self) -> np.ndarray:
        """Mean of the channels, (L, h, w) float32."""
        return self.colours.mean(-1)

    @cached_property
    def shaded(self) -> tuple[np.ndarray, np.ndarray]:
        """What Lambert's law says of each picture: as of `fit_shading`, (L, 3, 3) and (L,)."""
        every = zip(self.colours, self.clipped, strict=True)
        fits = [fit_shading(self.sphere, self.rows, self.columns, *picture) for picture in every]
        return np.array([shading for shading, _ in fits]), np.array([share for _, share in fits])

    @cached_property
    def offsets(self) -> np.ndarray:
        """How far from the ball's middle each pixel of the window looks, in radii, (h, w)."""
        return self.sphere.offsets(self.rows, self.columns)


def view_balls(pictures: Pictures, spheres: Sequence[Sphere], saturation: float) -> list[BallView]:
    """Look at balls in every picture, which is read once.

    Args:
        pictures: L of them.
        spheres: The balls.
        saturation: Radiance from which on a channel is clipped.
    """
    boxes = [_Box.around(sphere) for sphere in spheres]
    kept: list[list[tuple[np.ndarray, ...]]] = [[] for _ in spheres]
    whole = tuple(
        slice(min(getattr(box, axis).start for box in boxes), max(getattr(box, axis).stop for box in boxes))
        for axis in ("rows", "columns")
    )
    for number in progress_bar(range(len(pictures)), desc="balls", unit="picture", delay=5):
        seen = pictures.window(slice(number, number + 1), *whole)[0]
        for box, rows in zip(boxes, kept, strict=True):
            part = seen[box.inside(*whole)]
            clipped = box.reduce((part >= saturation).any(-1).astype(np.float32)) > 0.0
            rows.append((box.reduce(part), clipped))
    return [
        BallView(sphere, *box.places, np.array([part for part, _ in rows]), np.array([cut for _, cut in rows]))
        for box, sphere, rows in zip(boxes, spheres, kept, strict=True)
    ]


def fit_shading(
    sphere: Sphere, rows: np.ndarray, columns: np.ndarray, colours: np.ndarray, clipped: np.ndarray
) -> tuple[np.ndarray, float]:
    """Fit Lambert's law to pixels of a white ball that are lit and not clipped, by least squares without outliers.

    Args:
        sphere: The ball.
        rows, columns: (h, w) of its pixels.
        colours: (h, w, 3) their radiance.
        clipped: (h, w) bool.

    Returns:
        s (3, 3) of each channel, NaN where too little is lit; and which share of the variance it explains.
    """
    inside = (sphere.offsets(rows, columns) < _RIM) & ~clipped
    some = np.flatnonzero(inside)[:: max(1, int(inside.sum()) // _PIXELS)]
    _, normals, _ = sphere.hit(rows.flat[some], columns.flat[some])
    values = colours.reshape(-1, 3)[some].astype(np.float64)
    grey = values.mean(-1)
    if len(grey) < _FEWEST or not grey.any():
        return np.full((3, 3), np.nan), 0.0
    used = grey > 0.25 * np.percentile(grey, 95)
    light = np.zeros(3)
    for _ in range(_ROUNDS):
        if used.sum() < _FEWEST:
            return np.full((3, 3), np.nan), 0.0
        light = np.linalg.lstsq(normals[used], grey[used], rcond=None)[0]
        shown = normals @ light
        off = np.abs(grey - shown)
        lit = shown > _LIT * np.linalg.norm(light)
        used = lit & (off <= max(3.0 * float(np.median(off[lit])) if lit.any() else 0.0, 1e-9))
    if used.sum() < _FEWEST:
        return np.full((3, 3), np.nan), 0.0
    shading = np.linalg.lstsq(normals[used], values[used], rcond=None)[0].T
    left = float(((grey - np.maximum(shown, 0.0)) ** 2).sum())
    return shading, 1.0 - left / max(float(((grey - grey.mean()) ** 2).sum()), 1e-30)


@dataclass(frozen=True)
class _Box:
    """The window around a ball, and how many pixels of a side are taken together."""

    rows: slice
    columns: slice
    step: int

    @classmethod
    def around(cls, sphere: Sphere) -> "_Box":
        step = max(1, int(np.ceil(sphere.radius / _LARGEST)))
        down, along = _sides(sphere.outline(reach=1.15), sphere.shape, step)
        return cls(down, along, step)

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (h, w) of the middles of the pixels that are kept."""
        sides = [
            np.arange(side.start, side.stop, self.step) + (self.step - 1) / 2 for side in (self.rows, self.columns)
        ]
        rows, columns = np.meshgrid(*sides, indexing="ij")
        return rows, columns

    def inside(self, rows: slice, columns: slice) -> tuple[slice, slice]:
        """Return the window as a part of a larger one."""
        down, right = slice(self.rows.start - rows.start, self.rows.stop - rows.start), columns.start
        return down, slice(self.columns.start - right, self.columns.stop - right)

    def reduce(self, part: np.ndarray) -> np.ndarray:
        """Average squares of pixels (h, w, ...)."""
        if self.step == 1:
            return part
        height, width = (side // self.step for side in part.shape[:2])
        return part.reshape(height, self.step, width, self.step, *part.shape[2:]).mean((1, 3))


def _sides(places: tuple[np.ndarray, np.ndarray], shape: tuple[int, int], step: int) -> Iterator[slice]:
    """Yield the rows and the columns of points, inside the picture, a multiple of `step` of each."""
    for along, length in zip(places, shape, strict=True):
        start = int(np.clip(np.floor(along.min()) - 1, 0, length - step))
        stop = int(np.clip(np.ceil(along.max()) + 2, start + step, length))
        yield slice(start, start + (stop - start) // step * step)
