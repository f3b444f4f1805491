"""The bas-relief ambiguity by groups of normals and of albedos (Shi, Matsushita, Wei, Xu & Tan, CVPR 2010; "SM10").

Pixels of one chromaticity are taken to have one albedo; pixels of correlated profiles to have one normal. Equal albedos
at different normals give equations that are linear in the ambiguity.
"""

import logging

import numpy as np
from scipy.cluster.vq import kmeans2, vq

from render.shared.errors import InputError
from render.shared.seeds import generator
from sdps.classical.common.front_end import Front, Prepared, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.entropy import standard_form
from sdps.core.estimate import Estimate, Notes

_log = logging.getLogger(__name__)

_SAMPLES = 20000
"""Most pixels that are grouped; the rest has no say in three numbers."""

_NORMAL_GROUPS, _ALBEDO_GROUPS = 200, 20
"""K of the profiles, and of the chromaticities."""

_STEPS = 15
"""Iterations of k-means."""

_TIGHT = 0.003
"""Standard deviation of chromaticity within a group that counts as one colour, whatever other groups have."""

_DARK = 0.05
"""Pixels below this share of the median brightness are not grouped: their colour is noise."""


def grouping(
    images: np.ndarray, mask: np.ndarray, *, front: Front = "low-rank", draws: int = 50, seed: int = 0
) -> Estimate:
    """Choose the bas-relief transformation that makes albedos equal within every group of one chromaticity.

    Published: the two k-means groupings, of z-scored intensity profiles and of chromaticity; keeping the tighter half
    of the albedo groups and the inner pixels of each; one pixel per pair of groups; and the linear system
    (`solve_groups`). Ours: the standard form of the factors first, so that the answer does not depend on the
    factorisation; groups of truly one colour are always kept; and of `draws` random choices of pixels the one with
    the lowest median residual over all pixels kept. The radiometric calibration of the paper is left out: images are
    linear here.

    An object of one chromaticity forms one albedo group, and a warning says so: the system is solvable if it is painted
    uniformly, which these images cannot tell from a pattern in shades of one colour, where the answer is wrong.

    Args:
        images: (L, H, W, 3), linear radiance; white lights, or lights of one colour.
        mask: (H, W) bool.
        front: How highlights and shadows are kept out of the factorisation; see `prepare`.
        draws: Random choices of pixels.
        seed: Root seed of the groups and choices.

    Returns:
        Normals, lights and intensities; notes `albedo_groups` kept, and `residual`, the median relative deviation of
        squared albedo from its group's.

    Raises:
        InputError: grey images, parameters out of range, no draw that gives a real transformation, or degenerate
            input; see `prepare`.
    """
    if draws < 1:
        raise InputError(f"draws must be at least 1, got {draws}")
    if np.ndim(images) != 4 or np.shape(images)[-1] != 3:
        raise InputError(f"grouping by colour needs images (L, H, W, 3), got {np.shape(images)}; use `entropy` instead")
    prepared = prepare(images, mask, front=front)
    rng = generator(seed, "grouping")
    pixels, albedo, normal = _groups(prepared, rng)
    standard = standard_form(prepared.factors)
    best, residual = _best_draw(prepared.factors.transform(standard).surface[pixels], albedo, normal, draws, rng)
    return conclude(prepared, standard.then(best), Notes(albedo_groups=int(albedo.max()) + 1, residual=residual))


def _best_draw(
    surface: np.ndarray, albedo: np.ndarray, normal: np.ndarray, draws: int, rng: np.random.Generator
) -> tuple[Gbr, float]:
    """Solve draws of one pixel per pair of groups; return the transformation of least residual, and that residual."""
    best, residual = None, np.inf
    for _ in range(draws):
        chosen = _one_per_cell(albedo, normal, rng)
        found = solve_groups(surface[chosen], albedo[chosen])
        if found is None:
            continue
        spread = _residual(found, surface, albedo)
        if spread < residual:
            best, residual = found, spread
    if best is None:
        raise InputError(
            f"none of {draws} draws gives a real bas-relief transformation; the albedos of one colour differ "
            "too much or too few normals share one (small object, shadows, highlights); use another method"
        )
    return best, residual


def solve_groups(surface: np.ndarray, groups: np.ndarray) -> Gbr | None:
    """Solve s_1^2 + s_2^2 + 2 mu s_1 s_3 + 2 nu s_2 s_3 + l s_3^2 = a_r^2 for mu, nu, l and every a_r^2.

    This is |s G|^2 = a_r^2 with l = mu^2 + nu^2 + lambda^2 (Shi et al. 2010, sec. 4). Least squares; afterwards every
    equation is divided by its a_r^2 and the system solved once more, so that bright albedos do not outweigh dark ones.

    Args:
        surface: (N, 3), pseudo-normals s, albedo included.
        groups: (N,) int, group of equal albedo of each.

    Returns:
        The transformation, or None where the system is singular or lambda^2 is not positive.
    """
    first, second, third = surface.T
    members, index = np.unique(groups, return_inverse=True)
    system = np.zeros((len(surface), 3 + len(members)))
    system[:, :3] = np.stack([2.0 * first * third, 2.0 * second * third, third**2], axis=1)
    system[np.arange(len(surface)), 3 + index] = -1.0
    target = -(first**2 + second**2)
    weights = np.ones(len(surface))
    for _ in range(2):
        found, _, rank, _ = np.linalg.lstsq(system * weights[:, None], target * weights, rcond=None)
        squared = found[2] - found[0] ** 2 - found[1] ** 2
        if rank < system.shape[1] or squared <= 0.0 or (found[3:] <= 0.0).any():
            return None
        weights = 1.0 / found[3:][index]
    return Gbr(float(found[0]), float(found[1]), float(np.sqrt(squared)))


def _groups(prepared: Prepared, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (N,) worth using, and the albedo and the normal group of each, (N,) int."""
    brightness = prepared.profiles.mean(1)
    pixels = rng.permutation(np.flatnonzero(brightness > _DARK * np.median(brightness)))[:_SAMPLES]
    colour = prepared.observations.values[:, pixels].mean(0, dtype=np.float64)  # (N, 3)
    chromaticity = colour[:, :2] / colour.sum(1, keepdims=True)
    spread = np.sqrt(chromaticity.var(0).sum())
    labels = np.zeros(len(pixels), int)
    if spread > _TIGHT:
        labels = _k_means(chromaticity, _ALBEDO_GROUPS, rng)
    keep, labels = _tight_groups(chromaticity, labels)
    if labels.max() == 0:
        _log.warning("the object has a single chromaticity; one albedo is assumed for all of it")
    profiles = prepared.cleaned[pixels[keep]]
    profiles = profiles - profiles.mean(1, keepdims=True)
    profiles /= np.maximum(np.linalg.norm(profiles, axis=1, keepdims=True), 1e-12)  # Euclid is now correlation
    return pixels[keep], labels, _k_means(profiles, _NORMAL_GROUPS, rng)


def _k_means(points: np.ndarray, groups: int, rng: np.random.Generator) -> np.ndarray:  # (N,) int
    """Group points (N, D) into at most `groups`; fewer distinct points make fewer groups."""
    # Spread starts find every colour; for hundreds of groups they are slow, and a few merged normals do no harm.
    start = "++" if groups <= 50 else "points"
    sample = points[: 50 * groups]  # centres need no more
    distinct = np.unique(np.round(sample, 5), axis=0)
    if len(distinct) <= groups:
        return vq(points, distinct)[0]
    # The stubs know `minit` and `missing` as literals, and no `rng`.
    centres, _ = kmeans2(sample, groups, iter=_STEPS, minit=start, missing="warn", rng=rng)  # type: ignore[call-overload]
    return vq(points, centres)[0]


def _tight_groups(chromaticity: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the half of the groups with less variance and those of one colour, and of each the pixels near its centre.

    Returns indices (M,) of the pixels kept and their groups, numbered from 0, (M,).
    """
    _, labels, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    sums = [np.bincount(labels, weights=channel) / sizes for channel in chromaticity.T]
    distance = np.linalg.norm(chromaticity - np.stack(sums, axis=1)[labels], axis=1)
    deviation = np.sqrt(np.bincount(labels, weights=distance**2) / sizes)
    kept = deviation <= max(float(np.median(deviation)), _TIGHT)
    # A margin keeps all of a group whose pixels are equally far up to rounding.
    near = distance <= (np.bincount(labels, weights=distance) / sizes)[labels] + 1e-6
    keep = np.flatnonzero(kept[labels] & near)
    return keep, np.unique(labels[keep], return_inverse=True)[1]


def _one_per_cell(albedo: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:  # (M,)
    """Return one random pixel of every pair of an albedo group and a normal group that has any."""
    order = rng.permutation(len(albedo))
    cells = (albedo * (int(normal.max()) + 1) + normal)[order]
    return order[np.unique(cells, return_index=True)[1]]


def _residual(gbr: Gbr, surface: np.ndarray, groups: np.ndarray) -> float:
    """Return the median, over pixels, of the relative deviation of squared albedo from its group's mean."""
    squared = (gbr.surface(surface) ** 2).sum(1)
    mean = np.bincount(groups, weights=squared) / np.maximum(np.bincount(groups), 1)
    return float(np.median(np.abs(squared / np.maximum(mean[groups], 1e-300) - 1.0)))
