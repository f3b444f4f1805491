"""PF14: the ambiguity resolved by local diffuse maxima (Favaro & Papadhimitri, CVPR 2012; IJCV 2014).

Where a Lambertian surface of smooth albedo is locally brightest, its normal points at the light (LDR maximum). With the
pseudo-normal N and pseudo-light L of such a point, G of `Gbr` must make N G and G^-1 L parallel, which gives

    (mu, nu) = P1 + s (P0 - P1),    lambda = sqrt(s (1 - s)) |P0 - P1|,    0 < s < 1,

    P1 = (-N1, -N2) / N3,    P0 = P1 + (N.L) (L1, L2) / (N3 (L1^2 + L2^2)):

a half-circle over a segment of the (mu, nu) plane (CVPR 2012, sec. 3). Two segments that cross fix all three numbers,
and the median over all crossings survives many false maxima. The steps follow the paper and the published description
of its authors' code; ours are the distance kept from the mask's edge, the choice at random above `limit`, and a median
that takes the lambdas of both half-circles at every crossing.
"""

import logging
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.morphology import local_maxima

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.classical.common.factorisation import Factors
from sdps.classical.common.front_end import Front, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.core.estimate import Estimate, Notes

_log = logging.getLogger(__name__)

_BLOCK = 256
"""Segments intersected with all others at once; bounds memory to a few tens of MB."""

_PARALLEL = 1e-6
"""Sine of the angle between segments below which their crossing is not defined."""

_INTEGRABILITY = 2.5
"""Standard deviation in pixels of the Gaussian before integrability is imposed."""

_FEW = 50
"""Crossings below which the median is not to be trusted."""


@dataclass(frozen=True, eq=False)
class Maxima:
    """Points taken for local diffuse maxima.

    Attributes:
        pixels: (K,) int, row of the pixel in profiles (P, L).
        images: (K,) int, image in which it is brightest.
    """

    pixels: np.ndarray
    images: np.ndarray


def diffuse_maxima(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    front: Front = "low-rank",
    smoothing: float = 2.0,
    limit: int = 5000,
    seed: int = 0,
) -> Estimate:
    """Estimate normals and lights by local diffuse maxima (Favaro & Papadhimitri, CVPR 2012; IJCV 2014).

    Args:
        images, mask, front: As for `prepare`.
        smoothing: Standard deviation in pixels of the Gaussian before the search for maxima.
        limit: Most maxima to intersect; more are thinned at random.
        seed: Seed of that choice.

    Returns:
        Normals, light directions and intensities; notes `candidates`, `intersections` and `candidate_map`.

    Raises:
        InputError: degenerate input (see `prepare`), no maximum, or no two maxima that agree on any transformation.
    """
    prepared = prepare(images, mask, front=front, smoothing=_INTEGRABILITY)
    maxima = find_maxima(prepared.cleaned, prepared.mask, smoothing=smoothing)
    crossings, lambdas = intersect(prepared.factors, maxima, limit=limit, seed=seed)
    gbr = median_gbr(crossings, lambdas)
    found = np.full(int(prepared.mask.sum()), -1)
    found[maxima.pixels] = maxima.images
    notes = Notes(
        candidates=len(maxima.pixels),
        intersections=len(crossings),
        candidate_map=prepared.observations.to_map(found, -1).astype(np.int16),
    )
    return conclude(prepared, gbr, notes)


def find_maxima(profiles: np.ndarray, mask: np.ndarray, *, smoothing: float = 2.0) -> Maxima:
    """Return the points that are locally brightest in one image only.

    Points brightest in several images owe that to their albedo, not to their slope; points below half the range of the
    image are mostly interreflection and noise; points at the mask's edge are brightest only because it ends there.

    Args:
        profiles: (P, L), one intensity profile per row.
        mask: (H, W) bool with P true pixels.
        smoothing: Standard deviation in pixels of the Gaussian, cut off at 5.5 of it (23 x 23 pixels at 2).

    Raises:
        InputError: no such point.
    """
    if smoothing <= 0.0:
        raise InputError(f"smoothing must be positive, got {smoothing}")
    margin = max(2, round(smoothing))
    inner = ndimage.binary_erosion(np.pad(mask, 1), iterations=margin)[1:-1, 1:-1]
    weight = np.maximum(ndimage.gaussian_filter(mask.astype(float), smoothing, mode="constant", truncate=5.5), 1e-6)
    disc = ndimage.generate_binary_structure(2, 1)
    found = np.zeros((profiles.shape[1], *mask.shape), bool)
    bright = np.zeros_like(found)
    for index, profile in enumerate(profiles.T):
        image = np.zeros(mask.shape)
        image[mask] = profile
        image = ndimage.gaussian_filter(image, smoothing, mode="constant", truncate=5.5) / weight
        low, high = float(image[mask].min()), float(image[mask].max())
        if high <= low:
            continue
        peaks = local_maxima(np.where(mask, image, low), connectivity=2) & inner
        found[index] = ndimage.binary_dilation(peaks, disc) & mask
        bright[index] = image >= 0.5 * (high - low)
    chosen = found & bright & (found.sum(0) == 1)
    brightest, pixel = np.nonzero(chosen[:, mask])
    if not len(pixel):
        raise InputError(
            "no pixel is brightest in one image only; the object needs curved, diffuse parts facing lights"
        )
    return Maxima(pixels=pixel, images=brightest)


def intersect(
    factors: Factors, maxima: Maxima, *, limit: int = 5000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:  # (N, 2), (2 N,)
    """Cross the segments of all pairs of maxima.

    Args:
        factors: Integrable factors from any start: the answer moves along with it.
        maxima: Points taken for local diffuse maxima.
        limit: Most of them to use.
        seed: Seed of the choice among more.

    Returns:
        Crossings (mu, nu), and the lambdas of both half-circles there.

    Raises:
        InputError: no two segments cross.
    """
    start, step = _segments(factors, maxima)
    if len(start) > limit:
        keep = np.sort(generator(seed, "diffuse_maxima").choice(len(start), limit, replace=False))
        start, step = start[keep], step[keep]
    length = np.linalg.norm(step, axis=1)
    crossings, lambdas = [], []
    for first in progress_bar(range(0, len(start), _BLOCK), desc="diffuse maxima", unit="block"):
        rows = np.arange(first, min(first + _BLOCK, len(start)))[:, None]
        columns = np.arange(first + 1, len(start))[None]
        gap = start[columns] - start[rows]  # (R, C, 2)
        turn = _cross(step[rows], step[columns])
        usable = (np.abs(turn) > _PARALLEL * length[rows] * length[columns]) & (columns > rows)
        turn = np.where(usable, turn, 1.0)
        here, there = _cross(gap, step[columns]) / turn, _cross(gap, step[rows]) / turn  # shares s along each segment
        inside = usable & (here > 0.0) & (here < 1.0) & (there > 0.0) & (there < 1.0)
        row, column = np.nonzero(inside)
        here, there = here[inside], there[inside]
        row, column = rows[row, 0], columns[0, column]
        crossings.append(start[row] + here[:, None] * step[row])
        lambdas += [np.sqrt(here * (1.0 - here)) * length[row], np.sqrt(there * (1.0 - there)) * length[column]]
    points = np.concatenate(crossings) if crossings else np.empty((0, 2))
    if not len(points):
        raise InputError(
            f"{len(maxima.pixels)} brightest points agree on no transformation; too few are diffuse maxima"
        )
    if len(points) < _FEW:
        _log.warning("only %d pairs of diffuse maxima agree; the result is uncertain", len(points))
    return points, np.concatenate(lambdas)


def median_gbr(crossings: np.ndarray, lambdas: np.ndarray) -> Gbr:
    """Return the coordinate-wise median of crossings (N, 2) and lambdas (2 N,)."""
    mu, nu = np.median(crossings, axis=0)
    return Gbr(float(mu), float(nu), float(np.median(lambdas)))


def _segments(factors: Factors, maxima: Maxima) -> tuple[np.ndarray, np.ndarray]:  # (K', 2), (K', 2)
    """Return P1 and P0 - P1 of the maxima that constrain (mu, nu).

    Normals across the line of sight, lights along it and points in shade (N.L <= 0) define no segment; none of the
    three depends on the bas-relief transformation.
    """
    normals = factors.normals()[maxima.pixels]
    lights = unit(factors.lights.T[maxima.images])
    facing = (normals * lights).sum(1)
    slant = (lights[:, :2] ** 2).sum(1)
    valid = (np.abs(normals[:, 2]) > 1e-9) & (slant > 1e-18) & (facing > 0.0)
    normals, lights, facing, slant = normals[valid], lights[valid], facing[valid], slant[valid]
    start = -normals[:, :2] / normals[:, 2:]
    return start, (facing / (normals[:, 2] * slant))[:, None] * lights[:, :2]


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the z component of the cross product of vectors (..., 2)."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
