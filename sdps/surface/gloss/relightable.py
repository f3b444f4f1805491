"""Relightable pictures: `.ptm` (polynomial texture map, LRGB) and `.rti` (hemispherical harmonics, HSH).

Both hold, for each pixel, a few numbers that make its brightness a function of the light's direction (u, v, w): u
right, v up, w to the camera. Viewers show the sum as it is, so what is fitted are values for a screen (sRGB's curve):

    PTM   L = a0 u^2 + a1 v^2 + a2 u v + a3 u + a4 v + a5,  value = L rgb / 255        rows from bottom to top
    HSH   value_c = sum_k a_kc H_k(u, v, w)                                            rows from top to bottom

References: Malzbender, Gelb and Wolters, Polynomial Texture Maps, SIGGRAPH 2001, equation 7, and HP's PTM file format
1.2; Gautron et al., A Novel Hemispherical Basis, EGSR 2004, equations 7 and 11.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from render.shared.errors import InputError
from render.shared.files import atomic_path
from render.shared.imaging.srgb import to_srgb
from sdps.inference.tiles import split
from sdps.surface.gloss.pixel_lights import PixelLights

POLYNOMIAL = 6
"""Numbers of a pixel in a `.ptm`; as many lights are needed."""
HARMONICS = (4, 9)
"""Numbers of a pixel and channel in a `.rti` of order 2 and 3."""
_STEADY = 1e-3
"""Ridge, as a share of the lights: what lights do not determine stays small."""
_OUTLIERS = 0.02  # percent of the numbers at either end that may be clipped to a byte's range
_FULL, _FEW, _PART = 255.0, 2**20, 2**18
_BLOCK = 2**22  # pixels whose equations, of 180 bytes at most, are held at once where each sees lamps of its own
Expand = Callable[[np.ndarray], np.ndarray]
"""`expand_polynomial` or `expand_harmonics`: directions (n, 3) to (n, K)."""
Pictures = Callable[[], Iterable[np.ndarray]]
"""Starts reading pictures (n, 3), as often as it is called."""


def expand_polynomial(directions: np.ndarray) -> np.ndarray:
    """Return what a PTM's numbers are multiplied with, (L, 6), of unit directions (L, 3)."""
    u, v = np.asarray(directions, np.float64).T[:2]
    return np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=1)


def expand_harmonics(directions: np.ndarray, terms: int) -> np.ndarray:
    """Return the first 4 or 9 hemispherical harmonics of unit directions (L, 3), as (L, terms)."""
    x, y, z = np.asarray(directions, np.float64).T
    azimuth, z = np.arctan2(y, x), np.clip(z, 0.0, 1.0)
    shifted, across = 2.0 * z - 1.0, np.sqrt(z - z * z)
    found = [
        np.full_like(z, np.sqrt(1 / (2 * np.pi))),
        np.sqrt(6 / np.pi) * np.cos(azimuth) * across,
        np.sqrt(3 / (2 * np.pi)) * shifted,
        np.sqrt(6 / np.pi) * np.sin(azimuth) * across,
        -np.sqrt(30 / np.pi) * np.cos(2 * azimuth) * across**2,
        np.sqrt(30 / np.pi) * np.cos(azimuth) * shifted * across,
        np.sqrt(5 / (2 * np.pi)) * (1 - 6 * across**2),
        np.sqrt(30 / np.pi) * np.sin(azimuth) * shifted * across,
        -np.sqrt(30 / np.pi) * np.sin(2 * azimuth) * across**2,
    ]
    return np.stack(found[:terms], axis=1)


def fit_pictures(pictures: Iterable[np.ndarray], basis: np.ndarray) -> np.ndarray:
    """Return the numbers (K, n, 3) float32 that explain L pictures best, by least squares.

    Args:
        pictures: L arrays (n, 3), linear radiance under equal lights, 1 for white; read once.
        basis: (L, K), `expand_polynomial` or `expand_harmonics` of the lights.

    Raises:
        InputError: fewer lights than numbers.
    """
    count, terms = basis.shape
    _check(count, terms)
    ridge = _STEADY * count * np.eye(terms)
    solution = np.linalg.solve(basis.T @ basis + ridge, basis.T).astype(np.float32)  # (K, L)
    found = None
    for number, picture in enumerate(pictures):
        found = np.zeros((terms, *picture.shape), np.float32) if found is None else found
        for some in split(len(picture), _PART):
            shown = to_srgb(picture[some].astype(np.float32, copy=False))
            for term in range(terms):
                found[term, some] += solution[term, number] * shown
    if found is None:
        raise InputError("a relightable picture needs pictures")
    return found


def fit_near_pictures(pictures: Pictures, expand: Expand, lights: PixelLights) -> np.ndarray:
    """Return the same where each of n pixels sees the lamps from directions of its own.

    Args:
        pictures: L arrays (n, 3), their falloff taken off; read once for every four million pixels.
        expand: Gives what the numbers are multiplied with.
        lights: Of the n pixels.
    """
    count, terms = expand(lights.directions).shape
    _check(count, terms)
    found = np.empty((terms, len(lights.rows), 3), np.float32)
    for block in split(len(lights.rows), _BLOCK):
        _solve(found[:, block], pictures(), expand, lights.select(block), block)
    return found


def _solve(
    found: np.ndarray, pictures: Iterable[np.ndarray], expand: Expand, lights: PixelLights, block: slice
) -> None:  # fmt: skip
    """Write the numbers (K, m, 3) of a block of pixels, by least squares for each of them."""
    terms, pixels, _ = found.shape
    first, second = np.triu_indices(terms)
    products, found[:] = np.zeros((len(first), pixels), np.float32), 0.0
    for number, picture in enumerate(pictures):
        own = picture[block]
        for some in split(pixels, _PART):
            basis = expand(lights.reach(some, number)[0]).T.astype(np.float32)  # (K, p)
            shown = to_srgb(own[some].astype(np.float32, copy=False))
            for term in range(terms):
                found[term, some] += basis[term, :, None] * shown
            for row, (one, other) in enumerate(zip(first, second, strict=True)):
                products[row, some] += basis[one] * basis[other]
    for some in split(pixels, _PART):
        system = np.empty((products[:, some].shape[1], terms, terms))
        system[:, first, second] = system[:, second, first] = products[:, some].T
        system += _STEADY * len(lights.directions) * np.eye(terms)
        found[:, some] = np.linalg.solve(system, found[:, some].swapaxes(0, 1)).swapaxes(0, 1)


def _check(count: int, terms: int) -> None:
    """Refuse fewer lights than numbers."""
    if count < terms:
        raise InputError(f"a relightable picture of {terms} numbers a pixel needs {terms} lights or more, got {count}")


def measure_error(
    pictures: Iterable[np.ndarray], basis: np.ndarray, numbers: np.ndarray, expand: Expand | None = None,
    lights: PixelLights | None = None,
) -> float:  # fmt: skip
    """Return how far the fit is from what it was fitted to, root mean square of values for a screen, 0 to 1.

    Arguments as of `fit_pictures`, and what it returned; `expand` and `lights` as of `fit_near_pictures`.
    """
    few = slice(None, None, max(1, numbers.shape[1] // _PART))
    squares = []
    for number, picture in enumerate(pictures):
        if expand is None or lights is None:
            shown = np.tensordot(basis[number].astype(np.float32), numbers[:, few], 1)
        else:
            shown = np.einsum("pk,kpc->pc", expand(lights.reach(few, number)[0]), numbers[:, few])
        squares.append(float(((shown.clip(0.0, 1.0) - to_srgb(picture[few])) ** 2).mean()))
    return float(np.sqrt(np.mean(squares)))


def spread_lights(count: int) -> np.ndarray:
    """Return directions (count, 3) that are spread evenly from the camera down to 11 degrees above the horizon."""
    turn, z = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0)), np.linspace(0.99, 0.2, count)
    side = np.sqrt(1.0 - z * z)
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)


def write_ptm(path: str | Path, numbers: np.ndarray, mask: np.ndarray) -> None:
    """Write a `.ptm` (PTM_FORMAT_LRGB 1.2), black outside the mask.

    Args:
        path: The file.
        numbers: (6, n, 3) of `fit_pictures` with `expand_polynomial`, for the mask's pixels.
        mask: (H, W) bool.
    """
    colour, grey = np.empty_like(numbers[0]), np.empty(numbers.shape[:2], np.float32)  # (n, 3), (6, n)
    for some in split(len(colour), _PART):
        mean = np.maximum(_mean_shown(numbers[:, some]), 1e-6)
        colour[some] = mean / mean.max(axis=1, keepdims=True)
        grey[:, some] = _FULL * (numbers[:, some] * colour[some]).sum(axis=2) / (colour[some] ** 2).sum(axis=1)
    low, high = _ranges(grey)
    scale = np.maximum(high - low, 1e-3) / _FULL
    bias = np.rint(-low / scale)
    head = f"PTM_1.2\nPTM_FORMAT_LRGB\n{mask.shape[1]}\n{mask.shape[0]}\n"
    head += " ".join(f"{value:.7g}" for value in scale) + "\n" + " ".join(f"{value:.0f}" for value in bias) + "\n"
    scale = np.array([float(f"{value:.7g}") for value in scale])
    whole = np.zeros((*mask.shape, 9), np.uint8)
    whole[..., :6] = bias.astype(np.uint8)
    places, flat = np.flatnonzero(mask), whole.reshape(-1, 9)
    for some in split(len(places), _PART):
        flat[places[some], :POLYNOMIAL] = _to_bytes(grey[:, some].T / scale + bias)
        flat[places[some], POLYNOMIAL:] = _to_bytes(_FULL * colour[some])
    _write(path, head.encode(), whole[::-1, :, :POLYNOMIAL], whole[::-1, :, POLYNOMIAL:])


def write_rti(path: str | Path, numbers: np.ndarray, mask: np.ndarray) -> None:
    """Write a `.rti` (HSH 1.2), black outside the mask.

    Args:
        path: The file.
        numbers: (4 or 9, n, 3) of `fit_pictures` with `expand_harmonics`, for the mask's pixels.
        mask: (H, W) bool.
    """
    terms = len(numbers)
    low, high = _ranges(numbers.reshape(terms, -1))
    scale, bias = np.maximum(high - low, 1e-6).astype("<f4"), low.astype("<f4")
    head = f"#HSH1.2\n3\n{mask.shape[1]} {mask.shape[0]} 3\n{terms} 2 1\n".encode()
    zero = _to_bytes(-_FULL * bias / scale)
    whole = np.broadcast_to(zero, (*mask.shape, 3, terms)).copy()
    places, flat = np.flatnonzero(mask), whole.reshape(-1, 3, terms)
    for some in split(len(places), _PART):
        flat[places[some]] = _to_bytes(_FULL * (np.moveaxis(numbers[:, some], 0, -1) - bias) / scale)
    _write(path, head, scale, bias, whole)


def _mean_shown(numbers: np.ndarray) -> np.ndarray:  # (n, 3)
    """Return the mean colour of pixels under lights all around, 30 degrees from the camera; numbers (6, n, 3)."""
    around = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    u, v = 0.5 * np.cos(around), 0.5 * np.sin(around)
    basis = expand_polynomial(np.stack([u, v, np.sqrt(1.0 - u * u - v * v)], axis=1)).mean(axis=0)
    return np.clip(np.tensordot(basis, numbers, 1), 0.0, None)


def _ranges(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest of each row of numbers (K, m), but for outliers; 0 is between them."""
    found = [np.percentile(row[:: max(1, len(row) // _FEW)], [_OUTLIERS, 100.0 - _OUTLIERS]) for row in numbers]
    low, high = np.transpose(found)
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def _write(path: str | Path, head: bytes, *parts: np.ndarray) -> None:
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as handle:
        handle.write(head)
        for part in parts:
            handle.write(np.ascontiguousarray(part).data)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
