"""How each pixel of an object sees the lamps: from directions of its own where they are near, and from a line of sight
of its own where the camera is in perspective (`sdps.core.geometry`, `sdps.refinement.sites`).
"""

from typing import NamedTuple

import numpy as np
import torch

from sdps.core.geometry import Capture, are_near, reach
from sdps.inference.tiles import split
from sdps.refinement.sites import place_sites, see

_PART = 2**18  # pixels worked on at once


class PixelLights(NamedTuple):
    """Lamps, and where n pixels lie.

    Attributes:
        capture: The object before its camera.
        rows, columns: (n,) of the pixels.
        heights: (n,) z in pixels.
        directions: (L, 3) unit, from the object's middle to the lamps.
        nearness: (L,) rho of the lamps; None: distant.
    """

    capture: Capture
    rows: np.ndarray
    columns: np.ndarray
    heights: np.ndarray
    directions: np.ndarray
    nearness: np.ndarray | None = None

    @classmethod
    def of(
        cls, capture: Capture, chosen: np.ndarray, depth: np.ndarray, directions: np.ndarray,
        nearness: np.ndarray | None = None,
    ) -> "PixelLights":  # fmt: skip
        """Return the lamps of chosen pixels (H, W) bool, of depth (H, W); lamps all but distant count as distant."""
        rows, columns = (values.astype(np.int32) for values in np.nonzero(chosen))
        return cls(capture, rows, columns, depth[chosen], directions, nearness if are_near(nearness) else None)

    def thin(self, step: int) -> "PixelLights":
        """Return every `step`-th lamp."""
        nearness = None if self.nearness is None else self.nearness[::step]
        return self._replace(directions=self.directions[::step], nearness=nearness)

    def select(self, some: slice) -> "PixelLights":
        """Return the lamps of some pixels."""
        return self._replace(rows=self.rows[some], columns=self.columns[some], heights=self.heights[some])

    def reach(self, some: slice, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return unit directions (p, 3) and falloff (p,) of a near lamp at some pixels, float64."""
        assert self.nearness is not None  # distant lamps are alike for all pixels
        places = self.capture.place(self.rows[some], self.columns[some], self.heights[some])
        direction = np.asarray(self.directions[number], np.float64)[None]
        towards, falloff = reach(places, direction, np.asarray(self.nearness[number : number + 1], np.float64))
        return towards[:, 0], falloff[:, 0]

    def see(self, normals: np.ndarray, some: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return some pixels' unit normals (p, 3) and their lamps, turned until their lines of sight are z.

        Returns:
            Normals (p, 3), directions (L, 3) of all alike or (p, L, 3), and falloff (p, L); None: 1.
        """
        if self.nearness is None and not self.capture.camera.is_perspective:
            return normals, self.directions, None
        sites = place_sites(self.capture, self.rows[some], self.columns[some], self.heights[some])
        nearness = np.zeros(len(self.directions)) if self.nearness is None else self.nearness
        turned, directions, rho = (
            torch.from_numpy(np.asarray(values, np.float32)) for values in (normals, self.directions, nearness)
        )
        seen = see(turned, directions, rho, sites)
        assert seen.gain is not None  # there are sites
        return seen.normals.numpy(), seen.directions.numpy(), 1.0 / seen.gain.numpy()

    def even_out(self, values: np.ndarray, number: int) -> np.ndarray:  # (n, 3)
        """Return pixels (n, 3) of a photograph as if its lamp shone on all of them as on the object's middle."""
        if self.nearness is None:
            return values
        parts = [
            values[some] / self.reach(some, number)[1][:, None].astype(values.dtype)
            for some in split(len(values), _PART)
        ]
        return np.concatenate(parts)
