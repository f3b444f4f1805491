"""A ball before the camera: which pixels show it, where it turns each of them, and the outline that it has.

Frame and lengths are those of `sdps.core.geometry`: pixels at the object's mean depth, where the ball's middle is taken
to stand as well. An orthographic camera sees a circle. A pinhole sees an ellipse, which reaches beyond the ball's
equator and whose middle is not that of the ball; a pixel shows the ball if its line of sight passes the middle within
the radius, for both cameras.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdps.core.geometry import Camera

_OUTLINE = 64
_ROUNDS = 30


class Circle(NamedTuple):
    """What a ball's outline is taken for in a picture: column, row and radius, (0, 0) the centre of the first pixel."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball.

    Attributes:
        camera: What sees it.
        shape: (H, W) of the picture.
        x, y: Of its middle, whose z is 0.
        radius: In pixels.
    """

    camera: Camera
    shape: tuple[int, int]
    x: float
    y: float
    radius: float

    @classmethod
    def through(
        cls, camera: Camera, shape: tuple[int, int], rows: np.ndarray, columns: np.ndarray,
        start: "Sphere | None" = None, near: float = np.inf,
    ) -> "Sphere":  # fmt: skip
        """Return the ball whose outline passes closest to points (N,) of a picture (H, W), by least squares.

        Args:
            camera: What sees it.
            shape: Of the picture.
            rows, columns: Of the points.
            start: About where it is; None: about the points' mean.
            near: Pixels beyond which points count less and less.
        """
        column, row = camera.middle(shape)
        if start is None:
            x, y = columns.mean(), rows.mean()
            start = cls(camera, shape, x - column, row - y, np.hypot(columns - x, rows - y).mean())
        values = np.array([start.x, start.y, start.radius])
        at, sight = start._lines(rows, columns)
        for _ in range(_ROUNDS):  # of Gauss and Newton
            off = at - [values[0], values[1], 0.0]
            off = off - (off * sight).sum(-1, keepdims=True) * sight
            lengths = np.maximum(np.linalg.norm(off, axis=-1), 1e-9)
            weights = 1.0 / (1.0 + ((lengths - values[2]) / near) ** 2)
            slopes = np.column_stack([off[:, :2] / lengths[:, None], np.ones(len(off))])
            weighted = slopes * weights[:, None]
            step = np.linalg.lstsq(weighted.T @ slopes, weighted.T @ (lengths - values[2]), rcond=None)[0]
            values = values + step
            if np.abs(step).max() < 1e-6 * abs(values[2]):
                break
        return cls(camera, shape, float(values[0]), float(values[1]), max(abs(float(values[2])), 1e-3))

    @classmethod
    def of(cls, circle: Circle, camera: Camera, shape: tuple[int, int]) -> "Sphere":
        """Return the ball whose outline is best taken for a circle of a picture (H, W)."""
        if not camera.is_perspective:
            column, row = camera.middle(shape)
            return cls(camera, shape, circle.x - column, row - circle.y, circle.radius)
        turns = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)
        rows, columns = circle.y + circle.radius * np.sin(turns), circle.x + circle.radius * np.cos(turns)
        return cls.through(camera, shape, rows, columns)

    @property
    def middle(self) -> np.ndarray:
        """Its middle, (3,) float64."""
        return np.array([self.x, self.y, 0.0])

    @property
    def circle(self) -> Circle:
        """The circle that its outline is best taken for: its middle, and its mean radius."""
        rows, columns = self.outline()
        lengths = np.hypot(*(np.roll(places, -1) - np.roll(places, 1) for places in (rows, columns)))
        x, y = (float(np.average(places, weights=lengths)) for places in (columns, rows))
        return Circle(x, y, float(np.average(np.hypot(columns - x, rows - y), weights=lengths)))

    def outline(self, count: int = _OUTLINE, reach: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns (count,) of points of the outline, of a ball of `reach` times the radius."""
        turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        column, row = self.camera.middle(self.shape)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        if not self.camera.is_perspective:
            points = np.array([self.x, self.y]) + reach * self.radius * ring
            return row - points[:, 1], column + points[:, 0]
        pinhole = np.array([0.0, 0.0, self.camera.focal])
        away = self.middle - pinhole
        cut = (reach * self.radius) ** 2 / float(away @ away)
        side = np.cross(away, [0.0, 1.0, 0.0])
        axes = np.stack([side / np.linalg.norm(side), np.cross(side, away) / np.linalg.norm(np.cross(side, away))])
        rim = pinhole + (1.0 - cut) * away + reach * self.radius * np.sqrt(max(1.0 - cut, 0.0)) * ring @ axes
        seen = rim[:, :2] / (1.0 - rim[:, 2:] / self.camera.focal)
        return row - seen[:, 1], column + seen[:, 0]

    def offsets(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return how far lines of sight pass from the middle, in radii: below 1 where a pixel shows the ball."""
        start, sight = self._lines(rows, columns)
        return np.linalg.norm(np.cross(start - self.middle, sight), axis=-1) / self.radius

    def covers(self, reach: float = 1.0) -> np.ndarray:  # (H, W) bool
        """Return which pixels show a ball of `reach` times its radius."""
        rows, columns = np.arange(self.shape[0])[:, None], np.arange(self.shape[1])[None]
        x, y, radius = self.circle
        near = (np.abs(rows - y) <= 1.5 * reach * radius + 2) & (np.abs(columns - x) <= 1.5 * reach * radius + 2)
        found = np.zeros(self.shape, bool)
        some_rows, some_columns = np.nonzero(near)
        found[some_rows, some_columns] = self.offsets(some_rows, some_columns) <= reach
        return found

    def hit(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what pixels show: points of the surface, unit normals, unit vectors to the camera, each (..., 3).

        Pixels beside the ball count as of its rim.
        """
        start, sight = self._lines(rows, columns)
        off = start - self.middle
        along = -(off * sight).sum(-1)
        inside = self.radius**2 - (off * off).sum(-1) + along**2
        points = start + (along + np.sqrt(np.maximum(inside, 0.0)))[..., None] * sight
        normals = points - self.middle
        return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True), sight

    def mirror(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:  # (..., 3)
        """Return the unit directions of what a mirror shows in pixels: l = 2 (n . v) n - v."""
        _, normals, sight = self.hit(rows, columns)
        return 2.0 * (normals * sight).sum(-1, keepdims=True) * normals - sight

    def _lines(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of lines of sight at z = 0, and their unit directions to the camera."""
        sight = self.camera.look(self.shape, rows, columns)
        return self.camera.place(self.shape, rows, columns, 0.0), sight / np.linalg.norm(sight, axis=-1, keepdims=True)
