"""WT13: the bas-relief ambiguity resolved by the half-vector symmetry of highlights (Wu & Tan, CVPR 2013).

Reconstruction: the paper's abstract gives the principle, no code or equations were at hand. Published: under the
right normals and lights a two-dimensional slice of an isotropic BRDF taken from one image has low rank, and a
bas-relief transformation raises it. Ours, all of it: under a distant light and an orthographic camera the half vector
h and the difference angle are constant within an image, so the slice over (theta_h, phi_h) must have constant rows:
the specular part over n . l is a function of theta_h alone. That is measured without bins, by sorting the pixels by
theta_h and comparing neighbours (the ratio of von Neumann, 1941), and searched over the three numbers left.
"""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import half_vectors, unit
from render.shared.seeds import generator
from sdps.classical.common.bas_relief_search import minimise_over_bas_reliefs
from sdps.classical.common.front_end import Front, Prepared, conclude, prepare
from sdps.classical.common.gbr import Gbr
from sdps.classical.plain import equal_intensity
from sdps.core.estimate import Estimate, Notes

_log = logging.getLogger(__name__)

_GLOSS = 0.02
"""Share of the specular part in all light below which there is nothing to go by."""

_LIT = 0.1
"""Smallest n . l and n . v of a pixel that counts; beyond it reflectance is a ratio of small numbers."""

_POOR = 0.3
"""Energy above which the symmetry does not hold, or was not found; 0.001 to 0.1 is usual where it does."""

_MOST = 32
"""Images the energy is computed from at most, those with the strongest highlights."""

_PRIOR = 0.02
"""Weight of the variance of the log intensities of the lights, which decides where the energy is flat."""

_FEW = 30
"""Pixels an image needs for its highlight to count."""


def reflectance_symmetry(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    front: Front = "diffuse",
    samples: int = 1200,
    seed: int = 0,
) -> Estimate:
    """Find the bas-relief transformation under which every image's highlight is round about its half vector.

    Needs one specular lobe over the object (its albedo may vary) and highlights that the camera sees in several
    images. Where there are none the transformation of equal light intensities is returned, with a warning.

    Args:
        images, mask, front: As for `prepare`.
        samples: Most pixels per image the energy is computed from.
        seed: Root seed of the draw of pixels.

    Returns:
        Normals, lights; notes `highlights`, `energy`, `equal_energy`.

    Raises:
        InputError: degenerate input; see `prepare`.
    """
    if samples < 2 * _FEW:
        raise InputError(f"samples must be at least {2 * _FEW}, got {samples}")
    prepared = prepare(images, mask, front=front, minimum=6, seed=seed)
    start = gbr = equal_intensity(prepared.factors)
    share, chosen = highlight_images(prepared)
    notes = Notes(highlights=bool(share >= _GLOSS and len(chosen) >= 3))
    if not notes.highlights:
        _log.warning(
            "the specular part is %.1f %% of the light, seen in %d images: no highlights to go by; taking equal light "
            "intensities for granted", 100.0 * share, len(chosen),
        )  # fmt: skip
    else:
        pixels = generator(seed, "reflectance_symmetry").permutation(len(prepared.profiles))[:samples]
        energy = symmetry_energy(prepared, pixels, chosen, _PRIOR)
        gbr, lowest = minimise_over_bas_reliefs(energy, [start, Gbr()])
        if lowest > _POOR:
            _log.warning("the highlights keep an energy of %.2f: they are not symmetric, expect large errors", lowest)
        notes = replace(notes, energy=lowest, equal_energy=energy(start))
    return conclude(prepared, gbr, notes)


def highlight_images(prepared: Prepared) -> tuple[float, np.ndarray]:
    """Return the specular share of all light, and the images with the strongest highlights, (<= 32,) int."""
    total = np.maximum(prepared.profiles.sum(0), 1e-300)
    residual = prepared.specular()
    bright = (residual > 0.2 * prepared.cleaned.mean(0)).sum(0)
    shares = np.where(bright >= _FEW, residual.sum(0) / total, 0.0)
    order = np.argsort(-shares)[:_MOST]
    return float(residual.sum() / total.sum()), order[shares[order] > _GLOSS]


def symmetry_energy(prepared: Prepared, pixels: np.ndarray, chosen: np.ndarray, prior: float) -> Callable[[Gbr], float]:
    """Return the energy of a bas-relief transformation: 0 for round highlights, about 1 for no order at all."""
    surface, lights = prepared.factors.surface[pixels], prepared.factors.lights
    residual = prepared.specular(pixels)[:, chosen]  # (P', K)

    def energy(gbr: Gbr) -> float:
        vectors, sources = gbr.apply(surface, lights)
        normals = unit(vectors)
        strength = np.maximum(np.linalg.norm(sources, axis=0), 1e-12)
        if normals[:, 2].mean() < 0.0:
            return np.inf
        directions = (sources[:, chosen] / strength[chosen]).T  # (K, 3)
        shading = normals @ directions.T
        lit = (shading > _LIT) & (normals[:, 2:] > _LIT)
        disorder = _disorder(residual / np.maximum(shading, _LIT), normals @ half_vectors(directions).T, lit)
        return float(disorder) + prior * float(np.var(np.log(strength)))

    return energy


def _disorder(values: np.ndarray, keys: np.ndarray, valid: np.ndarray) -> float:
    """Return the mean over columns of von Neumann's ratio of values (P, K) in the order of keys (P, K).

    The squares of neighbours' differences over twice the variance; a column short of valid rows counts as 1.
    """
    order = np.argsort(np.where(valid, -keys, np.inf), axis=0)
    count = valid.sum(0)
    values = np.take_along_axis(values, order, axis=0)
    inside = np.arange(len(values))[:, None] < count
    mean = np.where(inside, values, 0.0).sum(0) / np.maximum(count, 1)
    variance = np.where(inside, (values - mean) ** 2, 0.0).sum(0) / np.maximum(count, 1)
    steps = np.where(inside[1:], np.diff(values, axis=0) ** 2, 0.0).sum(0) / np.maximum(count - 1, 1)
    ratio = np.minimum(steps / np.maximum(2.0 * variance, 1e-300), 1.0)
    return float(np.where(count >= _FEW, ratio, 1.0).mean())
