"""Normals from distances between intensity profiles (Lu et al., CVPR 2013; TPAMI 2015).

The profile of a pixel is its brightness over the images. Published: for isotropic reflectance under lights uniform over
the whole sphere, the geodesic distance between two profiles is linear in the angle between their normals; the
distribution of the intensities in a profile gives the slope; a matrix decomposition with missing data turns the angles
of near pairs into normals, up to a rotation and convex/concave.

Reconstruction: the papers' details are not public. Ours are how brightness is clipped and compressed, the gains, the
choice of samples, the part of the contour, the form of the slope and of the decomposition, the spread to all pixels,
and the lights.
"""

import logging

import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph, csr_matrix, linalg

from render.shared.errors import InputError
from render.shared.imaging.vectors import spiral, unit
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.classical.common.observations import observe
from sdps.classical.common.outlines import outward_gradient
from sdps.classical.common.weighted import normal_equations
from sdps.classical.profile_lights import CLIP, POWER, Lights, find_lights
from sdps.core.estimate import Estimate, Notes

_log = logging.getLogger(__name__)

_TRUSTED = np.radians(60.0)
"""Largest angle taken from a geodesic; longer ones collect the errors of many steps."""

_MINIMUM, _FEW = 10, 50
"""Images below which profiles say nothing, and below which they say little."""

_NEIGHBOURS = 12
"""Neighbours of a sample in the graph."""


def profile_distances(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    samples: int = 1500,
    slope: str = "contour",
    rounds: int = 2,
    seed: int = 0,
) -> Estimate:
    """Estimate normals and lights from geodesic distances between intensity profiles.

    Assumes isotropic, uniform reflectance (up to a scale per pixel), lights all around the object, no cast shadows, and
    a contour along which the surface turns away from the camera. Lights on the camera's side alone distort the
    distances and draw a warning.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance; 100 or more are wanted.
        mask: (H, W) bool.
        samples: Pixels embedded; all others follow from the nearest ones.
        slope: Radians per unit of distance, from the `contour` (normals there are a right angle off the view) or from
            the `distribution` of intensities (lights uniform over the sphere; no closed contour needed).
        rounds: Passes; each divides the images by the light intensities of the one before.
        seed: Seed of the samples.

    Returns:
        Normals, light directions, intensities of mean 1 (0 for black images); notes `residual`, the root mean square
        of the trusted cosines, and `light_mean`.

    Raises:
        InputError: fewer than 10 images, bad options, no contour, profiles that vary along one direction only
            (coplanar lights, a planar or cylindrical object), or that have nothing to do with the contour.
    """
    _check(len(images), samples, slope, rounds)
    observations = observe(images, mask, minimum=_MINIMUM)
    profiles = np.maximum(observations.grey(), 0.0).astype(np.float32)
    rng, inverse = generator(seed, "profile_distances"), _first_inverse(profiles)
    for _ in progress_bar(range(rounds), desc="profile distances", unit="round", disable=rounds < 2):
        shapes = compress(profiles * inverse)
        rows, normals, residual = _embed_samples(shapes, observations.mask, samples, slope, rng)
        lights = find_lights(profiles[rows], shapes[rows], normals)
        gains = lights.intensities
        inverse = np.where(gains > 0.0, 1.0 / np.maximum(gains, 1e-3), 1.0).astype(np.float32)
    mean = _mean_direction(lights)
    directions, intensities = lights.directions.astype(np.float32), lights.intensities.astype(np.float32)
    maps = observations.to_map(_spread_out(normalise(shapes), rows, normals))
    return Estimate(maps, directions, intensities, notes=Notes(residual=residual, light_mean=mean))


def _check(images: int, samples: int, slope: str, rounds: int) -> None:
    """Refuse options that make no sense, and warn of few images."""
    if slope not in ("contour", "distribution"):
        raise InputError(f"slope must be 'contour' or 'distribution', got {slope!r}")
    if samples < 100 or rounds < 1:
        raise InputError("profile distances need samples >= 100 and rounds >= 1")
    if _MINIMUM <= images < _FEW:
        _log.warning("%d images are few for profile distances; 100 or more are wanted", images)


def _mean_direction(lights: Lights) -> float:
    """Return the length of the mean light direction, with a warning where it says that lights are on one side."""
    mean = float(np.linalg.norm(lights.directions[lights.intensities > 0.0].mean(0)))
    if mean > 0.35:
        _log.warning(
            "the lights found do not surround the object (mean direction of length %.2f; 0 is all around, 0.5 a "
            "hemisphere); profile distances are then no measure of angle: expect a distorted shape", mean,
        )  # fmt: skip
    return mean


def compress(profiles: np.ndarray) -> np.ndarray:  # (P, L)
    """Cut each profile (P, L) at its upper quantile, bring it to a largest value of 1 and compress it."""
    top = np.quantile(profiles, CLIP, axis=1, keepdims=True)
    top = np.where(top > 0.0, top, profiles.max(1, keepdims=True))  # lit in too few images for the quantile
    return np.minimum(profiles / np.maximum(top, 1e-30), 1.0) ** POWER


def normalise(profiles: np.ndarray) -> np.ndarray:  # (P, L)
    """Return rows of zero mean and unit length: what albedo does not change."""
    return unit(profiles - profiles.mean(1, keepdims=True))


def contour(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the contour's rows among the mask's pixels (Q,), and outward unit vectors (Q, 2), y up.

    Pixels at the image's frame do not count; what lies behind them is unknown.
    """
    inner = ndimage.binary_erosion(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]
    rows = np.flatnonzero((mask & ~inner)[mask])
    outward = outward_gradient(mask, 2.0)[rows]
    length = np.linalg.norm(outward, axis=1)
    clear = length > 1e-3
    return rows[clear], outward[clear] / length[clear, None]


def geodesics(profiles: np.ndarray, neighbours: int) -> np.ndarray:  # (S, S)
    """Return shortest ways between normalised profiles (S, L) over nearest neighbours; inf where there is none."""
    steps = np.arccos(np.clip(profiles @ profiles.T, -1.0, 1.0))
    nearest = np.argpartition(steps, neighbours, axis=1)[:, : neighbours + 1]
    rows, columns = np.repeat(np.arange(len(steps)), neighbours + 1), nearest.ravel()
    # An explicit zero would read as "no edge".
    graph = csr_matrix((np.maximum(steps[rows, columns], 1e-9), (rows, columns)), shape=steps.shape)
    return csgraph.dijkstra(graph, directed=False)


def distribution_slope(shapes: np.ndarray, step: float = 0.15) -> float:
    """Return radians per unit of distance from the intensities in compressed profiles (S, L).

    Under lights uniform over the sphere, the share of lights with n . l > u is (1 - u) / 2: sorting a profile gives its
    brightness over n . l. The distance of two such profiles, `step` radians apart, gives the slope.
    """
    curve = np.sort(shapes, axis=1).mean(0)  # (L,)
    heights = (np.arange(len(curve)) + 0.5) / len(curve) * 2.0 - 1.0
    lights = spiral(4000)
    first = np.interp(lights[:, 2], heights, curve)
    second = np.interp(lights @ [np.sin(step), 0.0, np.cos(step)], heights, curve)
    return float(step / max(np.arccos(np.clip(np.corrcoef(first, second)[0, 1], -1.0, 1.0)), 1e-6))


def decompose(angles: np.ndarray, start: np.ndarray | None = None, limit: int = 60) -> np.ndarray:  # (S, 3)
    """Return unit vectors whose trusted cosines fit those of `angles` (S, S), by alternating least squares.

    Starts from `start`, or from the three largest eigenvectors of all cosines (classical scaling).
    """
    cosines = np.cos(np.minimum(angles, np.pi))
    weights = (angles < _TRUSTED).astype(np.float64)
    normals = _scale_classically(cosines)[0] if start is None else start
    for _ in range(limit):
        matrices, targets = normal_equations(normals, cosines, weights)
        solved = np.linalg.solve(matrices + 1e-6 * np.eye(3), targets[..., None])[..., 0]
        moved = unit(unit(solved) + normals)  # half steps: all rows move at once
        change, normals = float(np.abs(moved - normals).max()), moved
        if change < 5e-4:
            break
    return normals


def orient(normals: np.ndarray, rows: np.ndarray, outward: np.ndarray) -> np.ndarray:  # (S, 3)
    """Rotate and reflect normals (S, 3) so that `rows` of them lean along `outward` (Q, 2) and most face the camera."""
    targets = np.concatenate([outward, np.zeros((len(outward), 1))], axis=1)
    left, _, right = np.linalg.svd(normals[rows].T @ targets)
    turned = normals @ (left @ right)
    return turned * [1.0, 1.0, np.sign(turned[:, 2].mean()) or 1.0]


def _scale_classically(cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return classical scaling to three dimensions, (S, 3) unit, and the four largest eigenvalues, relative."""
    values, vectors = linalg.eigsh(cosines, k=4, which="LA", v0=np.ones(len(cosines)))
    order = np.argsort(values)[::-1]
    values, vectors = np.maximum(values[order], 1e-12), vectors[:, order]
    return unit(vectors[:, :3] * np.sqrt(values[:3])), values / values[0]


def _first_inverse(profiles: np.ndarray) -> np.ndarray:  # (L,)
    """Return rough inverse light intensities: a high quantile over pixels of equalised albedo.

    Light from behind leaves only a dim rim, so no image is raised by more than a factor of two over the median.
    """
    equal = profiles / np.maximum(profiles.std(1, keepdims=True), 1e-12)
    level = np.percentile(equal, 97.0, axis=0)
    return (1.0 / np.maximum(level, 0.5 * max(float(np.median(level)), 1e-12))).astype(np.float32)


def _choose_samples(unit: np.ndarray, usable: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return rows far from each other (farthest-point rule) among ten times as many random ones."""
    pool = rng.permutation(usable)[: 10 * count]
    if len(pool) <= count:
        return pool
    vectors = unit[pool]
    chosen, nearest = [0], vectors @ vectors[0]
    while len(chosen) < count:
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, vectors @ vectors[chosen[-1]])
    return pool[chosen]


def _embed_samples(
    shapes: np.ndarray, mask: np.ndarray, count: int, slope: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the rows of samples (S,), their normals (S, 3) in the camera frame, and the residual of these."""
    unit = normalise(shapes)
    usable = np.flatnonzero(shapes.std(1) > 1e-3)
    edge, outward = contour(mask)
    keep = np.isin(edge, usable)
    edge, outward = edge[keep], outward[keep]
    if len(usable) < 100 or len(edge) < 12:
        raise InputError(
            f"profile distances need 100 pixels that vary and a contour inside the image; got {len(usable)} and "
            f"{len(edge)} contour pixels"
        )
    around = np.argsort(np.arctan2(outward[:, 1], outward[:, 0]))
    picked = around[np.unique(np.linspace(0, len(edge) - 1, min(len(edge), max(count // 8, 12))).astype(int))]
    inside = _choose_samples(unit, usable, count - len(picked), rng)
    rows = np.unique(np.concatenate([inside, edge[picked]]))
    ways = geodesics(unit[rows], min(_NEIGHBOURS, len(rows) - 1))
    joined = np.isfinite(ways[np.isfinite(ways).sum(1).argmax()])
    if joined.mean() < 0.9:
        _log.warning("only %.0f%% of the profiles hang together; the others are left out", 100.0 * joined.mean())
    rows, ways = rows[joined], ways[np.ix_(joined, joined)]
    known = np.isin(edge[picked], rows)
    places, outward = np.searchsorted(rows, edge[picked][known]), outward[picked][known]
    return rows, *_solve(ways, places, outward, distribution_slope(shapes[rows]), slope, mask)


def _solve(
    ways: np.ndarray, places: np.ndarray, outward: np.ndarray, distribution: float, slope: str, mask: np.ndarray
) -> tuple[np.ndarray, float]:
    """Turn geodesics (S, S) into oriented normals (S, 3); also return how far their cosines are off."""
    along, correlation = _contour_slope(ways[np.ix_(places, places)], outward)
    if correlation < 0.5:
        raise InputError(
            f"profile distances do not follow the contour (correlation {correlation:.2f}); a planar object, coplanar "
            "lights, or noise"
        )
    beta = along if slope == "contour" else distribution
    spectrum = _scale_classically(np.cos(np.minimum(beta * ways, np.pi)))[1]
    if spectrum[2] < 0.02:
        raise InputError("the profiles vary along one direction only; coplanar lights or a cylindrical object")
    normals = orient(decompose(beta * ways), places, outward)
    if slope == "contour":
        # The rim alone is a poor ruler: distances along and across it differ on glossy surfaces. Instead its normals
        # must come out a right angle off the view, less what a pixel centre half a pixel inside a disc of this area is.
        target = np.arccos(min((np.pi / mask.sum()) ** 0.25, 0.5))
        for _ in range(3):
            polar = np.arccos(np.clip(normals[places, 2], -1.0, 1.0)).mean()
            beta *= float(np.clip(target / polar, 0.7, 1.4))
            normals = orient(decompose(beta * ways, normals), places, outward)
    if not 1 / 1.6 < beta / distribution < 1.6:
        _log.warning(
            "slope %.2f (%s) against %.2f by the distribution of intensities: the lights do not surround the object "
            "or its contour is not an occluding one", beta, slope, distribution,
        )  # fmt: skip
    trusted = beta * ways < _TRUSTED
    return normals, float(np.sqrt(np.mean((normals @ normals.T - np.cos(beta * ways))[trusted] ** 2)))


def _contour_slope(ways: np.ndarray, outward: np.ndarray) -> tuple[float, float]:
    """Return radians per unit of distance along the contour, and how well the two correlate."""
    angles = np.arccos(np.clip(outward @ outward.T, -1.0, 1.0))
    near = (angles > 0.05) & (angles < _TRUSTED)
    if not near.any() or ways[near].std() < 1e-9:
        raise InputError("the contour does not turn, or all profiles along it are alike; a planar object?")
    slope = (angles[near] * ways[near]).sum() / (ways[near] ** 2).sum()
    return float(slope), float(np.corrcoef(angles[near], ways[near])[0, 1])


def _spread_out(vectors: np.ndarray, rows: np.ndarray, normals: np.ndarray, nearest: int = 6) -> np.ndarray:  # (P, 3)
    """Give every profile the mean normal of the samples with the nearest profiles, the nearer the more."""
    sampled = vectors[rows]
    result = np.empty((len(vectors), 3), np.float64)
    for start in progress_bar(range(0, len(vectors), 8192), desc="normals of all pixels", unit="block", leave=False):
        cosine = vectors[start : start + 8192] @ sampled.T  # (B, S)
        best = np.argpartition(cosine, -nearest, axis=1)[:, -nearest:]
        distance = np.maximum(1.0 - np.take_along_axis(cosine, best, axis=1), 0.0)
        weight = 1.0 / (distance + 1e-4)
        result[start : start + 8192] = (weight[..., None] * normals[best]).sum(1)
    return unit(result)
