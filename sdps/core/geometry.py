"""Where an object, its camera and its lamps stood: lines of sight, positions, and how light reaches each pixel.

Camera frame: x right, y up, z to the camera. Lengths are in pixels at the object's mean depth; the origin lies there,
at the principal point. A pinhole stands at (0, 0, f), f its focal length in pixels, so that a point (X, Y, Z) is seen
at (x, y) = (X, Y) / (1 - Z / f); an orthographic camera has f = inf. Pixel p, light i:

    v'_p   = (-x_p / f, -y_p / f, 1),  v_p = v'_p / |v'_p|                 line of sight, from the surface to the camera
    X_p    = (x_p (1 - z_p / f),  y_p (1 - z_p / f),  z_p)                 position
    off_pi = l_i - rho_i (X_p - C) / R                                     towards lamp i, in its distances
    l_pi   = off_pi / |off_pi|,   falloff_pi = 1 / |off_pi|^2              direction, and irradiance over that at C

The object has its middle C, the mean of its pixels at mean depth, and its radius R, half the longer side of its box.
Lamp i stands in the direction l_i from C, at the distance R / rho_i; rho is its nearness, 0 of a distant lamp. Slopes
of the surface are -n_x / (n . v') and -n_y / (n . v'): the derivatives of z where f = inf, else of
w = -f log(1 - z / f). `render.records.view_geometry` has the same camera, its lengths in half image widths.
"""

from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

from render.shared.errors import InputError

Array = Any
"""A NumPy array or a torch tensor; all arguments of a call are of one kind. Torch is not loaded here."""
FAR = 0.01
"""Nearness below which lamps count as distant: over the object, directions differ by a degree at most."""


@dataclass(frozen=True)
class Camera:
    """A camera; orthographic unless it has a focal length.

    Attributes:
        focal: Focal length in pixels; inf: orthographic.
        principal: Column and row of the principal point, (0, 0) the centre of the first pixel; None: the middle of the
            picture.

    Raises:
        InputError: a focal length that is not above 0, or a principal point that is not two finite numbers.
    """

    focal: float = np.inf
    principal: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.focal > 0.0:
            raise InputError(f"focal length must be above 0, got {self.focal:g}; leave it out if it is not known")
        if self.principal is not None and not np.isfinite(self.principal).all():
            raise InputError(f"principal point must be a column and a row, got {self.principal}")

    @property
    def is_perspective(self) -> bool:
        """Whether lines of sight differ."""
        return bool(np.isfinite(self.focal))

    def middle(self, shape: tuple[int, int]) -> tuple[float, float]:
        """Return column and row of the principal point of a picture (H, W)."""
        return self.principal or ((shape[1] - 1) / 2, (shape[0] - 1) / 2)

    def crop(self, shape: tuple[int, int], row: int, column: int) -> "Camera":
        """Return the camera of a part of a picture (H, W) that begins at a row and a column."""
        if not self.is_perspective and self.principal is None:
            return self
        x, y = self.middle(shape)
        return Camera(self.focal, (x - column, y - row))

    def thin(self, shape: tuple[int, int], step: int) -> "Camera":
        """Return the camera of every `step`-th row and column of a picture (H, W)."""
        if not self.is_perspective and self.principal is None:
            return self
        column, row = self.middle(shape)
        return Camera(self.focal / step, (column / step, row / step))

    def scale(self, factor: float) -> "Camera":
        """Return the camera of the picture at `factor` times its size."""
        principal = None
        if self.principal is not None:
            principal = ((self.principal[0] + 0.5) * factor - 0.5, (self.principal[1] + 0.5) * factor - 0.5)
        return Camera(self.focal * factor, principal)

    def image_points(self, shape: tuple[int, int]) -> np.ndarray:  # (H, W, 2)
        """Return x and y of every pixel of a picture (H, W), float64."""
        return self.place(shape, *_every(shape), 0.0)[..., :2]

    def sights(self, shape: tuple[int, int]) -> np.ndarray:  # (H, W, 3)
        """Return v' of every pixel of a picture (H, W), float64: towards the camera, with z = 1."""
        return self.look(shape, *_every(shape))

    def views(self, shape: tuple[int, int]) -> np.ndarray:  # (H, W, 3)
        """Return the unit vectors v from the surface to the camera, of every pixel of a picture (H, W), float64."""
        towards = self.sights(shape)
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)

    def positions(self, heights: np.ndarray) -> np.ndarray:  # (H, W, 3)
        """Return X of every pixel, of heights z (H, W) in pixels, float64."""
        return self.place(heights.shape, *_every(heights.shape), heights)

    def place(
        self, shape: tuple[int, int], rows: np.ndarray, columns: np.ndarray, heights: np.ndarray | float
    ) -> np.ndarray:  # (..., 3)
        """Return X of some pixels of a picture (H, W), of their rows, columns and heights, float64; these broadcast."""
        column, row = self.middle(shape)
        shrunk = 1.0 - np.asarray(heights, np.float64) / self.focal
        return np.stack(np.broadcast_arrays((columns - column) * shrunk, (row - rows) * shrunk, heights), axis=-1)

    def look(self, shape: tuple[int, int], rows: np.ndarray, columns: np.ndarray) -> np.ndarray:  # (..., 3)
        """Return v' of some pixels of a picture (H, W), of their rows and columns, float64; these broadcast."""
        column, row = self.middle(shape)
        tilts = (column - columns) / self.focal, (rows - row) / self.focal
        return np.stack(np.broadcast_arrays(*tilts, 1.0), axis=-1)

    def height(self, logarithmic: np.ndarray) -> np.ndarray:
        """Return z of w = -f log(1 - z / f), what slopes integrate to, any shape."""
        if not self.is_perspective:
            return logarithmic
        return -self.focal * np.expm1(-logarithmic / self.focal)


def _every(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (H, 1) and columns (1, W) of every pixel."""
    return np.arange(shape[0])[:, None], np.arange(shape[1])[None]


ORTHOGRAPHIC = Camera()


@dataclass(frozen=True, eq=False)
class Rig:
    """What is known of the camera and the lamps.

    Attributes:
        camera: The camera.
        nearness: (L,) rho of the lamps, zeros for distant ones; None where it is not known.
        each: Where it is not known, each lamp may have a distance of its own.
    """

    camera: Camera = ORTHOGRAPHIC
    nearness: np.ndarray | None = None
    each: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether all lamps are known to be distant, and lines of sight are parallel."""
        return self.nearness is not None and not np.any(self.nearness) and not self.camera.is_perspective

    def check(self, count: int) -> None:
        """Refuse what cannot be the nearness of so many lamps.

        Raises:
            InputError: another number of values, or one that is not from 0 to below 1.
        """
        if self.nearness is None:
            return
        if np.shape(self.nearness) != (count,):
            raise InputError(f"{count} images need {count} values of light_nearness, got {np.shape(self.nearness)}")
        values = np.asarray(self.nearness)
        wrong = ~((values >= 0.0) & (values < 1.0))
        if wrong.any():
            raise InputError(
                f"light_nearness {values[wrong][0]:g}: must be the object's radius over the lamp's distance, from 0 "
                "(distant) to below 1 (the lamp would stand inside the object)"
            )


UNKNOWN = Rig()


@dataclass(frozen=True, eq=False)
class Capture:
    """An object before its camera.

    Attributes:
        camera: The camera.
        shape: (H, W) of its picture.
        centre: (3,) float64, C.
        radius: R.
    """

    camera: Camera
    shape: tuple[int, int]
    centre: np.ndarray
    radius: float

    @classmethod
    def of(cls, mask: np.ndarray, camera: Camera = ORTHOGRAPHIC) -> "Capture":
        """Return the capture of an object's pixels (H, W) bool."""
        rows, columns = np.nonzero(mask)
        column, row = camera.middle(mask.shape)
        centre = np.array([columns.mean() - column, row - rows.mean(), 0.0])
        return cls(camera, mask.shape, centre, max(np.ptp(rows), np.ptp(columns)) / 2 + 0.5)

    def places(self, heights: np.ndarray | None = None) -> np.ndarray:  # (H, W, 3)
        """Return (X - C) / R of every pixel, float64; of heights (H, W) in pixels, or at the object's mean depth."""
        return self.place(*_every(self.shape), 0.0 if heights is None else heights)

    def place(self, rows: np.ndarray, columns: np.ndarray, heights: np.ndarray | float) -> np.ndarray:  # (..., 3)
        """Return (X - C) / R of some pixels, of their rows, columns and heights in pixels, float64; these broadcast."""
        return (self.camera.place(self.shape, rows, columns, heights) - self.centre) / self.radius


def are_near(nearness: np.ndarray | None) -> TypeGuard[np.ndarray]:
    """Return whether any lamp stands so near that it matters; None: all are taken for distant."""
    return nearness is not None and bool(np.max(nearness, initial=0.0) > FAR)


def reach(places: Array, directions: Array, nearness: Array) -> tuple[Array, Array]:
    """Return how light reaches pixels: l (P, L, 3) unit, and falloff (P, L); NumPy, or torch and differentiable.

    Args:
        places: (P, 3), (X - C) / R.
        directions: (L, 3) unit, from C to the lamps.
        nearness: rho, (L,) or a number as an array ().
    """
    off = directions - nearness[..., None] * places[:, None]  # (P, L, 3)
    squared = (off * off).sum(-1)
    return off / squared[..., None] ** 0.5, 1.0 / squared
