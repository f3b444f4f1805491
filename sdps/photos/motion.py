"""Did the camera or the object move between photographs? Told from edges that no light can move.

Outlines and paint have their edges in the same place, with the same sign, under every light; edges of shading and
shadows wander with it. So every image's field of edge directions is laid over the sum of the fields before it, in which
the former add up and the latter do not (after the orientation correlation of Fitch, Kadyrov, Christmas, Kittler 2002).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import fft

START = 6
"""Images at the beginning that are taken to lie still: fewer, of opposite lights, may have no edge in common."""

LEAD = 0.08
"""Least lead in fit by which a shift is believed; static scenes without hard shadows on the ground stay under 0.02."""

FIT = 0.22
"""Least correlation with the other images by which a shift is believed."""

STEP = 1.9
"""Least shift that is believed, in pixels of the reduced window."""

_SIDE = 256  # of the reduced window, pixels
_MARGIN = 0.15  # of the object's size, kept around it for its outline
_REACH = 0.15  # longest shift looked for, as a part of the window's side
_STEEP = 0.4  # step of log brightness per pixel at which an edge counts half
_FLOOR = 0.05  # of the bright parts' level; what is darker hardly counts


@dataclass(frozen=True)
class Shift:
    """How far an image lies from the others.

    Attributes:
        rows, columns: In pixels of the photographs, positive down and to the right.
        lead: How much better the edges fit there than unmoved, as a part of the fit there.
        fit: Correlation of the edges with those of the others, at most 1.
    """

    rows: float = 0.0
    columns: float = 0.0
    lead: float = 0.0
    fit: float = 0.0

    @property
    def length(self) -> float:
        """Pixels of the photographs."""
        return float(np.hypot(self.rows, self.columns))


class Tracker:
    """Follows the edges of the object through a series of images.

    Its memory does not depend on their number: one spectrum of the reduced window.

    Args:
        mask: (H, W) bool, where the object is.
    """

    def __init__(self, mask: np.ndarray) -> None:
        sides = []
        for axis in (1, 0):
            inside = np.flatnonzero(mask.any(axis=axis))
            extra = round(_MARGIN * (inside[-1] - inside[0] + 1)) + 8
            sides.append(slice(max(int(inside[0]) - extra, 0), int(inside[-1]) + 1 + extra))
        self._window = tuple(sides)
        shape = mask[self._window].shape
        self._scale = max(1.0, max(shape) / _SIDE)  # photograph's pixels per pixel of the window
        self._size = [max(8, round(side / self._scale)) for side in shape]
        self._reach = [max(2, round(_REACH * side)) for side in self._size]
        # Room for the longest shift, or what leaves at one side would come back in at the other.
        self._padded = [fft.next_fast_len(a + b) for a, b in zip(self._size, self._reach, strict=True)]
        self._sum = np.zeros(self._padded, np.complex64)
        self._count = 0

    def add(self, grey: np.ndarray) -> Shift:
        """Measure an image (H, W) float32 against those before, and take it in where it lies."""
        spectrum = self._spectrum(grey)
        shift = self._compare(spectrum, self._sum)
        if self._count < START or not self.moved(shift):
            shift = Shift()
        self._sum += self._at(spectrum, shift)
        self._count += 1
        return shift

    def compare(self, grey: np.ndarray, before: Shift) -> Shift:
        """Measure an image that `add` took in with the shift `before` against all others."""
        spectrum = self._spectrum(grey)
        return self._compare(spectrum, self._sum - self._at(spectrum, before))

    def moved(self, shift: Shift) -> bool:
        """Whether a shift is longer and surer than what changing light alone brings about."""
        return shift.length >= STEP * self._scale and shift.lead >= LEAD and shift.fit >= FIT

    def _spectrum(self, grey: np.ndarray) -> np.ndarray:
        """Transform the field of edge directions, whose vectors are shorter than 1 where the edge is faint."""
        part = cv2.resize(grey[self._window], self._size[::-1], interpolation=cv2.INTER_AREA)
        part = cv2.GaussianBlur(part, (0, 0), 0.8)
        # The logarithm makes paint's edges equally steep in bright and in dim light.
        bright = np.log(part / (np.percentile(part, 99) + 1e-6) + _FLOOR)
        down, right = np.gradient(bright)
        edges = right + 1j * down
        edges /= np.abs(edges) + _STEEP
        edges[[0, -1]] = edges[:, [0, -1]] = 0
        return fft.fft2(edges.astype(np.complex64), self._padded)

    def _at(self, spectrum: np.ndarray, shift: Shift) -> np.ndarray:
        """Move a field back by a shift."""
        if not shift.length:
            return spectrum
        rows, columns = (
            np.exp(2j * np.pi * fft.fftfreq(side) * step / self._scale).astype(np.complex64)
            for side, step in zip(self._padded, (shift.rows, shift.columns), strict=True)
        )
        return spectrum * rows[:, None] * columns

    def _compare(self, spectrum: np.ndarray, reference: np.ndarray) -> Shift:
        """Find where two fields agree best, to a pixel of the window, and how much better than within one pixel."""
        fit = fft.ifft2(spectrum * reference.conj()).real
        down, right = self._reach
        near = np.roll(fit, (down, right), (0, 1))[: 2 * down + 1, : 2 * right + 1]
        best = float(near.max())
        if best <= 0:
            return Shift()
        place = np.unravel_index(int(near.argmax()), near.shape)
        still = float(near[down - 1 : down + 2, right - 1 : right + 2].max())
        return Shift(
            float(place[0] - down) * self._scale,
            float(place[1] - right) * self._scale,
            (best - still) / best,
            best * fit.size / float(np.linalg.norm(spectrum) * np.linalg.norm(reference)),
        )
