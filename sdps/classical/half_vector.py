"""LC18: normals by half-vector symmetry, pixel by pixel (Lu, Chen, Sato & Sato, "SymPS", TPAMI 2018).

Reconstruction: only the abstract was at hand. Published: an isotropic BRDF is a function of theta_h and theta_d (the
half-vector symmetry); a one-dimensional form of this gives the elevation of a normal, a two-dimensional one improves
the normal as a whole, also under uneven light. Ours: how the energies are measured; the azimuth from the mirror
symmetry of isotropic reflectance about the plane of normal and view; the lights of the uncalibrated case, those of
the diffuse part (`separation`) after the bas-relief transformation under which the same energy is lowest; the
solution at a subset of pixels, from which its difference to the diffuse fit is carried to all others.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import spatial

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit
from render.shared.progress import progress_bar
from render.shared.seeds import generator
from sdps.classical.common.bas_relief_search import minimise_over_bas_reliefs
from sdps.classical.common.front_end import Prepared, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.common.isotropy import asymmetries, asymmetry, azimuths, intensity_corrections, log_values
from sdps.classical.common.observations import MEAN, Observations
from sdps.classical.common.separation import diffuse_surface
from sdps.classical.least_squares import calibrate
from sdps.classical.plain import equal_intensity
from sdps.core.estimate import NO_NOTES, Estimate, Notes
from sdps.core.intensities import grey, scale_to_mean

_log = logging.getLogger(__name__)

_FEWEST, _ENOUGH = 10, 50
"""Images below which the method refuses, and below which it warns: neighbours in theta_h are then far apart."""

_PRIOR = 0.002
"""Weight of the variance of the log intensities when the bas-relief transformation is searched."""


def half_vector(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    light_directions: np.ndarray | None = None,
    intensities: np.ndarray | None = None,
    samples: int = 2500,
    updates: int = 1,
    seed: int = 0,
) -> Estimate:
    """Find the normals under which every pixel's reflectance is a smooth function of theta_h and theta_d.

    Meant for 100 images and more. Without given lights it needs highlights, like `reflectance_symmetry`: a purely
    diffuse object leaves the bas-relief transformation open, and that of equal light intensities is taken instead.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        light_directions: (L, 3) unit, from the surface to the light, where they are known.
        intensities: (L,) or (L, 3), with known directions only; equal ones when absent.
        samples: Most pixels that are solved on their own.
        updates: How often intensities that are not known are re-estimated from the solved pixels.
        seed: Root seed of the draw of pixels.

    Returns:
        Normals and lights; note `solved`; uncalibrated also `gbr`, `highlights`, and `energy` and `equal_energy` of the
        bas-relief transformation.

    Raises:
        InputError: fewer than 10 images, lights that do not fit them, or degenerate input; see `prepare`.
    """
    given = intensities is not None
    if samples < 100 or updates < 0:
        raise InputError(f"need samples >= 100 and updates >= 0, got {samples} and {updates}")
    if given and light_directions is None:
        raise InputError("intensities were given without light_directions; give both, or neither")
    if _FEWEST <= len(images) < _ENOUGH:
        _log.warning("half-vector symmetry wants %d images or more, got %d; expect rough normals", _ENOUGH, len(images))
    if light_directions is None:
        scene, start, notes = _solve_uncalibrated(images, mask, seed)
    else:
        known = calibrate(images, mask, light_directions, intensities, weights=MEAN, minimum=_FEWEST)
        lights = unit(known.directions)
        scene = _Scene(known.observations, known.profiles, lights, np.ones(len(lights)))
        start, notes = diffuse_surface(scene.profiles, scene.lights), NO_NOTES
    normals, strengths, solved = _normals(scene, _visible(start), samples, 0 if given else updates, seed)
    notes = replace(notes, solved=solved)
    return scene.estimate(normals, grey(known.intensities) if given else strengths, notes)


@dataclass(frozen=True, eq=False)
class _Scene:
    """Grey profiles (P, L), unit lights (L, 3), and the intensities that the profiles still hold, (L,)."""

    observations: Observations
    profiles: np.ndarray
    lights: np.ndarray
    intensities: np.ndarray

    def estimate(self, normals: np.ndarray, intensities: np.ndarray, notes: Notes) -> Estimate:
        """Return normals (P, 3), the lights and intensities (L,) of mean 1 as an estimate."""
        relative = scale_to_mean(intensities).astype(np.float32)
        return Estimate(self.observations.to_map(normals), self.lights.astype(np.float32), relative, notes=notes)


def _normals(
    scene: _Scene, start: np.ndarray, samples: int, updates: int, seed: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Solve some pixels, carry the outcome to all and keep it where it is better; return normals, intensities and how
    many were solved.
    """
    lights = np.asarray(scene.lights, np.float64)
    chosen = np.sort(generator(seed, "half_vector").permutation(len(start))[:samples])
    first = scene.intensities.astype(np.float64)
    solved, intensities = _solve(scene.profiles[chosen], start[chosen], lights, first, updates)
    values = log_values(scene.profiles, intensities)
    carried = _carry(start, chosen, solved, scene.observations.mask)
    before, after = asymmetries(values, start, lights), asymmetries(values, carried, lights)
    return np.where((after < before)[:, None], carried, start), intensities, len(chosen)


def _solve_uncalibrated(images: np.ndarray, mask: np.ndarray, seed: int) -> tuple[_Scene, np.ndarray, Notes]:
    """Choose the bas-relief transformation by the asymmetry of some pixels; return lights, normals (P, 3) and notes."""
    prepared = prepare(images, mask, front="diffuse", minimum=_FEWEST, seed=seed)
    start = equal_intensity(prepared.factors)
    glossy = np.flatnonzero(prepared.specular().sum(1) > 0.05 * prepared.profiles.sum(1))
    gbr = start
    notes = Notes(highlights=len(glossy) >= 30)
    if notes.highlights:
        pixels = generator(seed, "half_vector lights").permutation(glossy)[:150]
        energy = _bas_relief_energy(prepared, pixels)
        gbr, lowest = minimise_over_bas_reliefs(energy, [start, Gbr()])
        notes = replace(notes, energy=lowest, equal_energy=energy(start))
    else:
        _log.warning("only %d pixels show highlights; taking equal light intensities for granted", len(glossy))
    found = conclude(prepared, gbr, notes)
    scene = _Scene(prepared.observations, prepared.profiles, found.light_directions, found.intensities)
    return scene, found.normals[prepared.mask], found.notes


def _bas_relief_energy(prepared: Prepared, pixels: np.ndarray) -> Callable[[Gbr], float]:
    surface, profiles = prepared.factors.surface[pixels], prepared.profiles[pixels]

    def energy(gbr: Gbr) -> float:
        vectors, sources = gbr.apply(surface, prepared.factors.lights)
        strength = np.maximum(np.linalg.norm(sources, axis=0), 1e-12)
        normals = unit(vectors)
        if normals[:, 2].mean() < 0.0:
            return np.inf
        found = asymmetry(log_values(profiles, strength), normals, (sources / strength).T)
        return float(found.mean()) + _PRIOR * float(np.var(np.log(strength)))

    return energy


def _solve(
    profiles: np.ndarray, start: np.ndarray, lights: np.ndarray, intensities: np.ndarray, updates: int
) -> tuple[np.ndarray, np.ndarray]:
    """Solve pixels (P', L) on their own; returns normals (P', 3) and intensities (L,)."""
    values = log_values(profiles, intensities)
    azimuth = azimuths(values, lights)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    best, energy = start, asymmetry(values, start, lights)
    for angle in progress_bar(np.radians(np.arange(-84.0, 85.0, 4.0)), desc="elevation", unit="angle"):
        trial = np.concatenate([np.sin(angle) * flat, np.full((len(flat), 1), np.cos(angle))], axis=1)
        best, energy = _keep_better(values, lights, best, energy, trial)
    best, energy = _refine(values, lights, best, energy, (4.0, 2.0, 1.0, 0.5, 0.25))
    for _ in range(updates):
        intensities = intensities * intensity_corrections(values, best, lights)
        values = log_values(profiles, intensities)
        best, energy = _refine(values, lights, best, asymmetry(values, best, lights), (0.5, 0.25))
    return best, intensities


def _keep_better(
    values: np.ndarray, lights: np.ndarray, best: np.ndarray, energy: np.ndarray, trial: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    found = asymmetry(values, trial, lights)
    better = found < energy
    return np.where(better[:, None], trial, best), np.where(better, found, energy)


def _refine(
    values: np.ndarray, lights: np.ndarray, best: np.ndarray, energy: np.ndarray, steps: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Descend on the hemisphere: the eight neighbours at each step size (degrees), twice."""
    for step in progress_bar([size for size in steps for _ in range(2)], desc="normals", unit="step"):
        first = unit(np.cross(best, [0.0, 1.0, 0.0]))
        second = np.cross(best, first)
        centre, size = best, np.tan(np.radians(step))
        for turn in np.arange(8) * np.pi / 4.0:
            trial = centre + size * (np.cos(turn) * first + np.sin(turn) * second)
            best, energy = _keep_better(values, lights, best, energy, _visible(trial))
    return best, energy


def _visible(normals: np.ndarray) -> np.ndarray:  # (P, 3)
    """Return unit normals that do not turn away from the camera, of vectors (P, 3) of any length."""
    normals = unit(normals)
    return unit(np.column_stack([normals[:, :2], np.maximum(normals[:, 2], 0.02)]))


def _carry(start: np.ndarray, chosen: np.ndarray, solved: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (P, 3)
    """Carry the difference of solved and diffuse normals to all pixels, from neighbours alike in place and normal."""
    rows, columns = np.nonzero(mask)
    place = np.stack([columns, rows], axis=1) * (2.0 / np.sqrt(len(rows)))
    features = np.concatenate([place, 4.0 * start], axis=1)
    count = min(8, len(chosen))
    distance, nearest = map(np.asarray, spatial.cKDTree(features[chosen]).query(features, k=count))
    weight = 1.0 / (distance + 0.05)
    weight /= weight.sum(1, keepdims=True)
    change = (solved - start[chosen])[nearest]  # (P, 8, 3)
    typical = np.median(change, axis=1, keepdims=True)
    apart = np.linalg.norm(change - typical, axis=2)
    weight = weight * (apart <= 1.5 * np.median(apart, axis=1, keepdims=True) + 1e-9)  # leaves failures out
    change = (weight[..., None] * change).sum(1) / np.maximum(weight.sum(1), 1e-12)[:, None]
    return _visible(start + change)
