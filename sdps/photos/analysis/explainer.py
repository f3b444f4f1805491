"""Which shift of a picture do the pictures under other lights explain best? Small tiles vote.

Under other lights a matte surface looks like a weighted sum of its other pictures: three suffice within a small tile,
a few more where there is gloss, shadow or a near lamp (Shashua 1997; tracking on such a subspace: Hager and Belhumeur
1998). The weights are the tile's own, so fall-off and shading, however they wander, are explained where the picture
lies, and a picture that moved is explained elsewhere. Edges alone cannot say this: those of a fine relief lie in other
places under every light, and all over the frame on the same side.

The pictures are kept as sums: number k is added to field k mod 10, with a random sign from the 11th on. Such sums span
what the pictures span (a count sketch; Clarkson and Woodruff 2013), and a picture can be taken out of them again.

Legend: T tiles of p pixels, S shifts, h x w the reduced window.
"""

from dataclasses import dataclass

import cv2
import numpy as np

_FIELDS = 10
_RANK = 8
_NOISE = 0.004  # of the bright parts' level
_TELLING = 1.5  # median over the shifts of a tile's residual, over the least: the tile has something to tell
_REACH, _AROUND = 4, 3  # pixels looked at around a place, in the search and in the judgement
_SMALLEST = 96  # shorter side of a window that is halved once more
_FEWEST = 4  # tiles
_SHORTEST = 1.9  # pixels


@dataclass(frozen=True)
class Votes:
    """How the tiles of a picture vote on where it lies.

    Attributes:
        rows, columns: The shift in question, pixels of the reduced window.
        agree: Tiles that are explained best within a pixel of it.
        against: Tiles that are explained best within a pixel of no shift.
        telling: Tiles whose pixels can tell one shift from another; the rest of them voted for others.
    """

    rows: int = 0
    columns: int = 0
    agree: int = 0
    against: int = 0
    telling: int = 0

    def is_carried(self, least: float, share: float, times: float) -> bool:
        """Whether enough tiles agree: so many, such a share of the telling ones, and so many times those against."""
        return self.agree >= max(least, share * self.telling, times * self.against)


class Explainer:
    """Ten fields of the reduced window that span what the pictures taken in show.

    Args:
        size: (h, w).
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._fields = np.zeros((_FIELDS, *size), np.float32)
        self._used = np.zeros(_FIELDS, np.int64)

    def take(self, number: int, part: np.ndarray, sign: int = 1) -> None:
        """Add the reduced picture (h, w) of a number, or take it out again with `sign` -1."""
        own = 1 if number < _FIELDS or np.random.default_rng(number).random() < 0.5 else -1
        self._fields[number % _FIELDS] += np.float32(sign * own) * part
        self._used[number % _FIELDS] += sign

    def search(self, part: np.ndarray) -> Votes:
        """Find the shift that most tiles of a reduced picture (h, w) agree on, in the window and in it halved."""
        fields = self._fields[self._used > 0]
        here, there, scale, places = part, fields, 1, []
        while True:
            place = _propose(here, there)
            places += [(place[0] * scale, place[1] * scale)] if place else []
            if min(here.shape) < _SMALLEST:
                break
            half = (here.shape[1] // 2, here.shape[0] // 2)
            here = cv2.resize(here, half, interpolation=cv2.INTER_AREA)
            there = np.stack([cv2.resize(field, half, interpolation=cv2.INTER_AREA) for field in there])
            scale *= 2
        found = [_judge(part, fields, place) for place in dict.fromkeys(places)]
        return max(found, key=lambda votes: votes.agree - 2 * votes.against, default=Votes())

    def judge(self, part: np.ndarray, rows: int, columns: int) -> Votes:
        """Count the votes of a reduced picture (h, w) for a shift, or one within two pixels of it."""
        return _judge(part, self._fields[self._used > 0], (rows, columns))


def _propose(part: np.ndarray, fields: np.ndarray) -> tuple[int, int] | None:
    """Return the shift, not zero, that most tiles are explained best by."""
    tiles = _Tiles(part.shape, (_REACH, _REACH))
    if len(tiles) < _FEWEST:
        return None
    shifts = np.array(_square((0, 0), _REACH))
    best, telling = tiles.best(part, fields, shifts)
    votes = np.zeros((2 * _REACH + 1, 2 * _REACH + 1), np.float32)
    np.add.at(votes, tuple((best[telling] + _REACH).T), 1)
    counts = cv2.boxFilter(votes, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    counts[_REACH - 1 : _REACH + 2, _REACH - 1 : _REACH + 2] = 0
    if counts.max() < max(2, 0.1 * np.count_nonzero(telling)):
        return None
    row, column = np.unravel_index(int(counts.argmax()), counts.shape)
    return int(row) - _REACH, int(column) - _REACH


def _judge(part: np.ndarray, fields: np.ndarray, place: tuple[int, int]) -> Votes:
    """Let the tiles choose between the surroundings of no shift and those of a place, or of a better one close by."""
    votes = _poll(part, fields, place)
    if votes.agree < _FEWEST:
        return votes
    return _poll(part, fields, (votes.rows, votes.columns), bracketed=True)


def _poll(part: np.ndarray, fields: np.ndarray, place: tuple[int, int], *, bracketed: bool = False) -> Votes:
    """Count votes, those at the rim of the surroundings only while the place is not known: there, tiles ask for more.

    A smooth gradient, of a highlight or a near lamp, is explained the better the farther it is moved.
    """
    tiles = _Tiles(part.shape, (abs(place[0]) + _AROUND, abs(place[1]) + _AROUND))
    if len(tiles) < _FEWEST:
        return Votes(*place)
    shifts = np.array(sorted({*_square((0, 0), _AROUND), *_square(place, _AROUND)}))
    best, telling = tiles.best(part, fields, shifts)
    still = np.abs(best).max(1) <= 1
    free = telling & ~still
    if bracketed:
        free &= np.abs(best - place).max(1) < _AROUND
    against, voters = int((still & telling).sum()), int(telling.sum())
    middles = [shift for shift in _square(place, 2) if np.hypot(*shift) >= _SHORTEST]
    near = [free & (np.abs(best - shift).max(1) <= 1) for shift in middles]
    most = max(near, key=lambda one: int(one.sum()))
    if not most.any():
        return Votes(*place, 0, against, voters)
    rows, columns = np.rint(np.median(best[most], axis=0)).astype(int).tolist()
    return Votes(rows, columns, int(most.sum()), against, voters)


class _Tiles:
    """Square tiles of a window, a margin away from its rim."""

    def __init__(self, shape: tuple[int, ...], margin: tuple[int, int]) -> None:
        self._side = side = int(np.clip(min(shape) // 8, 10, 24))
        rows, columns = (
            range(edge, length - side - edge + 1, side) for edge, length in zip(margin, shape, strict=True)
        )
        self._corners = np.array([(row, column) for row in rows for column in columns], np.int64).reshape(-1, 2)

    def __len__(self) -> int:
        return len(self._corners)

    def best(self, part: np.ndarray, fields: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the best of the shifts (S, 2) for every tile, (T, 2), and which tiles can tell, (T,) bool."""
        side = (self._side, self._side)
        window = np.lib.stride_tricks.sliding_window_view(part, side)
        seen = np.lib.stride_tricks.sliding_window_view(fields, side, axis=(1, 2))
        left = np.empty((len(self), len(shifts)), np.float32)
        for number, (row, column) in enumerate(self._corners):
            moved = window[row + shifts[:, 0], column + shifts[:, 1]].reshape(len(shifts), -1)
            weights = moved @ _basis(seen[:, row, column].reshape(len(fields), -1))
            left[number] = np.einsum("sp,sp->s", moved, moved) - np.einsum("sk,sk->s", weights, weights)
        squares = np.maximum(left, 0) / self._side**2 + _NOISE**2
        return shifts[squares.argmin(1)], np.median(squares, axis=1) > _TELLING * squares.min(1)


def _basis(seen: np.ndarray) -> np.ndarray:  # (p, k)
    """Return an orthonormal basis of the rows of (M, p), zero where there is only noise."""
    values, vectors = np.linalg.eigh(seen @ seen.T)
    values, vectors = values[::-1][:_RANK], vectors[:, ::-1][:, :_RANK]
    good = (values > _NOISE**2 * seen.shape[1]) & (values > 1e-5 * values[0])
    return seen.T @ (vectors * (good / np.sqrt(np.maximum(values, 1e-12))))


def _square(middle: tuple[int, int], reach: int) -> list[tuple[int, int]]:
    """Return the places within `reach` of a place in both axes."""
    steps = range(-reach, reach + 1)
    return [(middle[0] + row, middle[1] + column) for row in steps for column in steps]
