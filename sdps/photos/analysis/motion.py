"""Did the camera or the object move between photographs? Two witnesses that no light can move.

Tiles of a picture are explained by the other pictures where the picture lies: they vote on its shift (`explainer`).

Outlines and paint have their edges in the same place, with the same sign, under every light; edges of shading, shadows
and highlights wander with it. So every image's field of edge directions is laid over the sum of the fields of the
others, in which the former add up and the latter do not (after the orientation correlation of Fitch, Kadyrov,
Christmas, Kittler 2002), and the places where the others disagree count little.

A whole frame has no outline, and its edges may all be relief: there the votes decide. Before a dark background few
tiles may see anything, and highlights have sharp edges as well, so edges, votes and the silhouette must agree, unless
the votes are many: an object that moved is lit where the others show background, and shows background where it was. An
image that is dark there tells nothing and passes, unless it lies where another surely does.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import fft, ndimage

from sdps.photos.analysis.explainer import Explainer

START = 3
"""Images at the beginning that are taken to lie still: three explain a matte surface under a fourth light."""

_EDGES_FROM = 6  # images: fewer, of opposite lights, may have no edge in common

LEAD = 0.08
"""Least lead in fit by which a shift is believed."""

FIT = 0.1
"""Least correlation with the other images by which a shift is believed, where the silhouette agrees."""

WHOLE = (5, 0.35, 3.0)
"""Votes by which a shift is believed where the frame is the object: tiles, share of the telling ones, times those
against."""

SURE = (12, 0.5, 3.0)
"""Votes by which a shift is believed before a background, against edges and silhouette."""

WHOLE_OF_FEW = (6, 0.6, 4.0)
"""The same where there are few other images, which may not explain a new light."""

SUSPICIOUS = (3, 0.17, 1.0)
"""Votes by which an image is worth a second look."""

BESIDE_EDGES = (4, 0.25, 2.0)
"""Votes that must come to edges and silhouette."""

_FEW = 7  # images

LIT_AHEAD, LIT_BEHIND = 0.1, 0.05
"""Least share of the pixels newly covered that is lit, and largest share of those uncovered, if the object moved."""

STEP = 1.9
"""Least shift that is believed, in pixels of the reduced window."""

_SIDE = 256  # of the reduced window, pixels
_MARGIN = 0.15  # of the object's size, kept around it for its outline
_REACH = 0.15  # longest shift looked for, as a part of the window's side
_STEEP = 0.4  # step of log brightness per pixel at which an edge counts half
_FLOOR = 0.05  # of the bright parts' level; what is darker hardly counts
_AGREEMENT = 4  # power of the agreement between the images by which an edge counts
_LIT = 0.02  # of the bright parts' level, above the background: a pixel is lit
_COVERED = 0.05  # share of the images that light a pixel of the object at least
_FULL = 0.85  # share of the window that a silhouette may cover
_WHOLE = 0.97  # share of the window that the mask covers where there is no background
_BRIGHTEST = 2.0  # of the bright parts' level; highlights above count as this bright


@dataclass(frozen=True)
class Shift:
    """How far an image lies from the others.

    Attributes:
        rows, columns: In pixels of the photographs, positive down and to the right.
        suspicious: The image is worth a second look.
        sure: The shift is longer and surer than what changing light alone brings about.
        alike: Where another image surely lies just so, this one does.
    """

    rows: float = 0.0
    columns: float = 0.0
    suspicious: bool = False
    sure: bool = False
    alike: bool = False

    @property
    def length(self) -> float:
        """Pixels of the photographs."""
        return float(np.hypot(self.rows, self.columns))


@dataclass(frozen=True, eq=False)
class View:
    """What the tracker sees of an image, in the reduced window of h x w pixels.

    Attributes:
        edges: (h, w) complex64, right + i down, towards the brighter side, shorter than 1 where the edge is faint.
        lit: (h, w) bool, brighter than the background.
        part: (h, w) float32, the brightness, 1 for that of the bright parts.
    """

    edges: np.ndarray
    lit: np.ndarray
    part: np.ndarray


class Tracker:
    """Follows the edges of the object through a series of images.

    Its memory does not depend on their number: some fifteen fields of the reduced window.

    Args:
        mask: (H, W) bool, where the object is.

    Attributes:
        suspects: Numbers of the images to measure again: whose edges seem to have moved, and the first, which had
            little to be compared with.
    """

    def __init__(self, mask: np.ndarray) -> None:
        sides = []
        for axis in (1, 0):
            inside = np.flatnonzero(mask.any(axis=axis))
            extra = round(_MARGIN * (inside[-1] - inside[0] + 1)) + 8
            sides.append(slice(max(int(inside[0]) - extra, 0), int(inside[-1]) + 1 + extra))
        self._window = tuple(sides)
        shape = mask[self._window].shape
        self._whole = bool(mask[self._window].mean() > _WHOLE)
        self._scale = max(1.0, max(shape) / _SIDE)  # photograph's pixels per pixel of the window
        self._size = [max(8, round(side / self._scale)) for side in shape]
        self._reach = [max(2, round(_REACH * side)) for side in self._size]
        # Room for the longest shift, or what leaves at one side would come back in at the other.
        self._padded = [fft.next_fast_len(a + b) for a, b in zip(self._size, self._reach, strict=True)]
        self._edges = np.zeros(self._size, np.complex64)  # sums over the images, each where it lies
        self._strength = np.zeros(self._size, np.float32)
        self._lit = np.zeros(self._size, np.int32)
        self._explainer = Explainer((self._size[0], self._size[1]))
        self._count = 0
        self.suspects: list[int] = []

    def __len__(self) -> int:
        """Return how many images were taken in."""
        return self._count

    def add(self, grey: np.ndarray) -> Shift:
        """Measure an image (H, W) float32 against those before, and take it in where it lies."""
        view = self.view(grey)
        shift = self.compare(view) if self._count >= START else Shift()
        if self._count < START or shift.suspicious:
            self.suspects.append(self._count)
        if not shift.sure:
            shift = Shift()
        self.take(self._count, view, shift)
        return shift

    def view(self, grey: np.ndarray) -> View:
        """Reduce an image (H, W) float32 to its edges and its lit part."""
        part = cv2.resize(grey[self._window], self._size[::-1], interpolation=cv2.INTER_AREA)
        part = cv2.GaussianBlur(part, (0, 0), 0.8)
        level = float(np.percentile(part, 99)) + 1e-6
        # The logarithm makes paint's edges equally steep in bright and in dim light.
        down, right = np.gradient(np.log(part / level + _FLOOR))
        edges = right + 1j * down
        edges /= np.abs(edges) + _STEEP
        edges[[0, -1]] = edges[:, [0, -1]] = 0
        rim = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
        ground = float(np.median(rim))
        noise = 1.48 * float(np.median(np.abs(rim - ground)))
        lit = part > ground + max(_LIT * level, 6 * noise)
        return View(edges.astype(np.complex64), lit, np.minimum(part / level, _BRIGHTEST))

    def take(self, number: int, view: View, shift: Shift, sign: int = 1) -> None:
        """Add the view of image `number`, moved back by its shift, to the others; with `sign` -1, take it out again."""
        back = self._steps(shift, -1)
        edges, lit, part = (_move_field(field, *back) for field in (view.edges, view.lit, view.part))
        self._edges += sign * edges
        self._strength += sign * np.abs(edges)
        self._lit += sign * lit.astype(np.int32)
        self._explainer.take(number, part, sign)
        self._count += sign

    def compare(self, view: View) -> Shift:
        """Find where a view that is not taken in agrees best with those that are, to a pixel of the window."""
        votes = self._explainer.search(view.part)
        outline = self._lit >= max(2, _COVERED * self._count)
        whole = self._whole or not 0 < outline.mean() < _FULL
        few = self._count < _FEW
        needed = (WHOLE_OF_FEW if few else WHOLE) if whole else SURE
        if votes.is_carried(*needed):
            return self._shift(votes.rows, votes.columns, suspicious=True, sure=True, alike=True)
        if whole or self._count < _EDGES_FROM:
            return self._shift(votes.rows, votes.columns, suspicious=votes.is_carried(*SUSPICIOUS))
        return self._edges_shift(view, outline)

    def _edges_shift(self, view: View, outline: np.ndarray) -> Shift:
        """Find where a view's edges lie, and ask the silhouette (h, w) bool and the votes about it."""
        agreement = np.abs(self._edges) / (self._strength + 0.02 * max(self._count, 1))
        reference = self._edges * agreement**_AGREEMENT
        product = fft.fft2(view.edges, self._padded) * fft.fft2(reference, self._padded).conj()
        down, right = self._reach
        near = np.roll(fft.ifft2(product).real, (down, right), (0, 1))[: 2 * down + 1, : 2 * right + 1]
        best = float(near.max())
        if best <= 0:
            return Shift()
        place = np.unravel_index(int(near.argmax()), near.shape)
        still = float(near[down - 1 : down + 2, right - 1 : right + 2].max())
        rows, columns = int(place[0]) - down, int(place[1]) - right
        fit = best / float(np.linalg.norm(view.edges) * np.linalg.norm(reference))
        if np.hypot(rows, columns) < STEP or (best - still) / best < LEAD or fit < FIT:
            return Shift()
        votes = self._explainer.judge(view.part, rows, columns)
        ahead, behind = _silhouette(outline, view.lit, rows, columns)
        alike = behind <= LIT_BEHIND and votes.agree >= votes.against
        sure = alike and ahead >= LIT_AHEAD and votes.is_carried(*BESIDE_EDGES)
        return self._shift(rows, columns, suspicious=True, sure=sure, alike=alike)

    def _shift(self, rows: int, columns: int, **said: bool) -> Shift:
        """Return a shift by pixels of the window."""
        return Shift(rows * self._scale, columns * self._scale, **said)

    def near(self, shift: Shift, sure: Shift) -> bool:
        """Whether a shift is one that was believed, or the same movement seen with its front side in the dark."""
        apart = np.hypot(shift.rows - sure.rows, shift.columns - sure.columns)
        return shift == sure or (shift.alike and apart < STEP * self._scale)

    def _steps(self, shift: Shift, sign: int) -> tuple[int, int]:
        """Return a shift in pixels of the window."""
        return sign * round(shift.rows / self._scale), sign * round(shift.columns / self._scale)


def second_look(tracker: Tracker, shifts: list[Shift], image: Callable[[int], np.ndarray]) -> list[Shift]:
    """Measure the suspects again.

    All that still look moved are taken out first, then each is measured against the rest: images that moved together
    would speak for each other. Where the rest are few, what they do not convict goes back, and whoever is left is
    measured once more. Of a camera held in the hand nothing is left as a rest, and the first look stands, in which
    every image was laid on the others as they lie.

    Args:
        tracker: Has taken in all images.
        shifts: What `add` returned for each.
        image: Returns the brightness (H, W) of the image of a number, up to three times.

    Returns:
        A shift per image, of zero length unless it moved.
    """
    if _wanders(shifts):
        return list(shifts)
    apart = []
    for number in tracker.suspects:
        if len(tracker) <= START:
            break
        view = tracker.view(image(number))
        tracker.take(number, view, shifts[number], -1)
        if tracker.compare(view).suspicious:
            apart.append(number)
        else:
            tracker.take(number, view, Shift())
    found = _keep_sure(tracker, apart, image)
    if found and len(tracker) < _FEW:
        for number in apart:
            if number not in found:
                tracker.take(number, tracker.view(image(number)), Shift())
        found = _keep_sure(tracker, list(found), image)
    return [found.get(number, Shift()) for number in range(len(shifts))]


def _wanders(shifts: list[Shift]) -> bool:
    """Whether most images moved, each to a place of its own."""
    places = np.array([(shift.rows, shift.columns) for shift in shifts if shift.length])
    lengths = np.hypot(*places.T) if len(places) else np.zeros(0)
    return len(places) > len(shifts) / 2 and bool(places.std(0).max() > 0.25 * lengths.mean())


def _keep_sure(tracker: Tracker, numbers: list[int], image: Callable[[int], np.ndarray]) -> dict[int, Shift]:
    """Measure images that are not taken in, and return the shifts that are sure, or like one that is."""
    found = {number: tracker.compare(tracker.view(image(number))) for number in numbers}
    sure = [shift for shift in found.values() if shift.sure]
    return {number: shift for number, shift in found.items() if any(tracker.near(shift, one) for one in sure)}


def _silhouette(outline: np.ndarray, lit: np.ndarray, rows: int, columns: int) -> tuple[float, float]:
    """Return which share is lit of what the outline (h, w), shifted, newly covers, and of what it uncovers."""
    shifted = _move_field(outline, rows, columns)
    covered = shifted & ~ndimage.binary_dilation(outline)
    uncovered = outline & ~ndimage.binary_dilation(shifted)
    ahead, behind = (float(lit[part].mean()) if part.any() else 0.0 for part in (covered, uncovered))
    return ahead, behind


def _move_field(field: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Move a field (h, w) down and to the right, zero where nothing came from."""
    if not rows and not columns:
        return field
    out = np.zeros_like(field)
    height, width = field.shape
    out[max(rows, 0) : height + min(rows, 0), max(columns, 0) : width + min(columns, 0)] = field[
        max(-rows, 0) : height + min(-rows, 0), max(-columns, 0) : width + min(-columns, 0)
    ]
    return out
