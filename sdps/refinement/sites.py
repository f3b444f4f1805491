"""Where the refined pixels lie, and how each of them sees the lamps.

Near lamps light every pixel from a direction and with a strength of its own, and a perspective camera looks at every
pixel along a line of sight of its own (`sdps.core.geometry`). Reflectance depends on angles alone, so a pixel's normal
and lamps are turned until its line of sight is z: all equations of `reflectance` hold there as they are written.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sdps.core.first_normals import turn_to_sight
from sdps.core.geometry import Camera, Capture, reach
from sdps.core.integration import integrate

_LEAST = 1e-3
"""Cosine to the line of sight that normals keep, at least."""


class Sites(NamedTuple):
    """Where P pixels lie.

    Attributes:
        places: (P, 3) (X - C) / R.
        sights: (P, 3) v', towards the camera, z = 1.
        turns: (P, 3, 3), rotations that bring the lines of sight to z.
    """

    places: Tensor
    sights: Tensor
    turns: Tensor

    def select(self, part: slice | Tensor) -> "Sites":
        """Return the sites of some pixels."""
        return Sites(*(values[part] for values in self))


class Seen(NamedTuple):
    """Normals and lamps as pixels see them: the line of sight is z.

    Attributes:
        normals: (P, 3) unit.
        directions: (L, 3) unit, of all pixels alike, or (P, L, 3).
        gain: (P, L), what observations are multiplied by: 1 / falloff; None: 1.
    """

    normals: Tensor
    directions: Tensor
    gain: Tensor | None = None

    @property
    def cosines(self) -> Tensor:  # (P, L)
        """n . l."""
        if self.directions.ndim == 2:
            return self.normals @ self.directions.T
        return (self.directions @ self.normals[..., None])[..., 0]

    def even_out(self, images: Tensor) -> Tensor:  # (P, 3, L)
        """Return images as they would be if lamps were equally strong at every pixel."""
        return images if self.gain is None else images * self.gain[:, None]


class Grid(NamedTuple):
    """Every `stride`-th row and column of an object.

    Attributes:
        capture: The object before its camera.
        mask: (H, W) bool, all its pixels.
        stride: Of the grid.
    """

    capture: Capture
    mask: np.ndarray
    stride: int

    def sites(self, heights: np.ndarray | None = None) -> Sites:
        """Return where its pixels lie, of heights (h, w) in steps of the grid, or all at the object's mean depth."""
        rows, columns = np.nonzero(self.which)
        found = np.zeros(len(rows))
        if heights is not None:
            found += self.stride * heights[rows // self.stride, columns // self.stride]
        return place_sites(self.capture, rows, columns, found)

    def integrate(self, normals: Tensor) -> np.ndarray:  # (h, w)
        """Return the heights of its normals (P, 3), in steps of the grid."""
        mask = self.mask[:: self.stride, :: self.stride]
        laid = np.zeros((*mask.shape, 3))
        laid[mask] = normals.numpy()
        return integrate(laid, mask, discontinuities=True, camera=self.camera).z

    @property
    def which(self) -> np.ndarray:  # (H, W) bool
        """Which pixels are on it."""
        return select_grid(self.mask, self.stride)

    @property
    def camera(self) -> Camera:
        """The camera of the grid's picture."""
        return self.capture.camera.thin(self.capture.shape, self.stride)


def place_sites(capture: Capture, rows: np.ndarray, columns: np.ndarray, heights: np.ndarray) -> Sites:
    """Return the sites of the pixels at rows (P,) and columns (P,) of a picture, of heights (P,) in pixels."""
    found = capture.place(rows, columns, heights), capture.camera.look(capture.shape, rows, columns)
    places, sights = (torch.from_numpy(each.astype(np.float32)) for each in found)
    return Sites(places, sights, turn_to_sight(sights))


def select_grid(mask: np.ndarray, stride: int) -> np.ndarray:
    """Return which pixels of a mask (h, w) are on the grid of every `stride`-th row and column."""
    grid = np.zeros_like(mask)
    grid[::stride, ::stride] = mask[::stride, ::stride]
    return grid


def keep_in_sight(vectors: Tensor, sites: Sites | None) -> None:
    """Move vectors (P, 3), about unit, that look away from the camera along their lines of sight until they are seen
    edge-on.
    """
    if sites is None:
        vectors[:, 2].clamp_min_(_LEAST)
        return
    towards = sites.turns[:, 2]  # what is turned to z: the unit line of sight
    cosines = (vectors * towards).sum(dim=1, keepdim=True)
    vectors += (_LEAST - cosines).clamp_min_(0.0) * towards


def see(normals: Tensor, directions: Tensor, nearness: Tensor, sites: Sites | None) -> Seen:
    """Return normals (P, 3) and lamps, unit directions (L, 3) and nearness (L,), as pixels see them; differentiable."""
    if sites is None:
        return Seen(normals, directions)
    towards, falloff = reach(sites.places, directions, nearness)
    turned = (sites.turns @ normals[..., None])[..., 0]
    return Seen(turned, towards @ sites.turns.transpose(1, 2), 1.0 / falloff)
