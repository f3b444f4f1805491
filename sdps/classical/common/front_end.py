"""The shared front end of the uncalibrated methods: from images to what lacks only a bas-relief transformation.

Check, tell Lambert's law from highlights and shadows, factorise, impose integrability, orient.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from render.shared.errors import unknown
from sdps.classical.common.factorisation import Factors, factorise, impose_integrability, orient
from sdps.classical.common.gbr import Gbr
from sdps.classical.common.observations import Observations, observe
from sdps.classical.common.rpca import robust_low_rank
from sdps.classical.common.separation import diffuse_factors
from sdps.classical.common.shadows import fit_lit
from sdps.core.estimate import NO_NOTES, Estimate, Notes
from sdps.core.intensities import scale_to_mean

Front = Literal["low-rank", "diffuse", "none"]


@dataclass(frozen=True, eq=False)
class Prepared:
    """The state in which an uncalibrated method starts.

    Attributes:
        observations: The images at the object's pixels.
        profiles: (P, L) grey intensity profiles as they are.
        cleaned: (P, L) without highlights, as the front end sees them; `profiles` if it does not look.
        factors: Integrable factors, oriented; short of a bas-relief transformation.
    """

    observations: Observations
    profiles: np.ndarray
    cleaned: np.ndarray
    factors: Factors

    @property
    def mask(self) -> np.ndarray:
        """(H, W) bool."""
        return self.observations.mask

    def specular(self, pixels: np.ndarray | slice = slice(None)) -> np.ndarray:  # (P', L)
        """Return the specular part, what exceeds the cleaned profiles, of some pixels by index, or of all."""
        return np.maximum(self.profiles[pixels] - self.cleaned[pixels], 0.0)


def prepare(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    front: Front = "low-rank",
    smoothing: float = 1.0,
    minimum: int = 4,
    seed: int = 0,
) -> Prepared:
    """Run the shared front end: check, clean, factorise, make integrable, orient.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        front: How highlights and shadows are kept out of the three dimensions. `low-rank`, the published way, removes a
            sparse part (`rpca`), and leaves shadows out of the fit (`shadows`). `diffuse` fits max(b . s, 0) to the
            samples that follow it (`separation`): better on glossy objects, worse where there are few images, cast
            shadows or interreflections. `none` factorises the images as they are.
        smoothing: See `impose_integrability`.
        minimum: Fewest images the method can work with.
        seed: Root seed of the pixels the lights are fitted on.

    Raises:
        InputError: an unknown front end, or degenerate input; see `observe`, `factorise`, `impose_integrability`.
    """
    if front not in get_args(Front):
        raise unknown("front end", front, get_args(Front))
    observations = observe(images, mask, minimum=minimum)
    profiles = observations.grey()
    cleaned = robust_low_rank(profiles, progress=True) if front == "low-rank" else profiles
    factors = factorise(cleaned)
    singular = factors.singular  # of the images, not of a fit
    if front == "low-rank":
        factors = fit_lit(profiles, cleaned, factors.lights, seed=seed)
    elif front == "diffuse":
        factors = diffuse_factors(profiles, seed=seed)
        cleaned = np.maximum(factors.surface.astype(np.float32) @ factors.lights.astype(np.float32), 0.0)
    factors = impose_integrability(replace(factors, singular=singular), observations.mask, smoothing=smoothing)
    return Prepared(observations, profiles, cleaned, orient(factors, observations.mask))


def conclude(prepared: Prepared, gbr: Gbr, notes: Notes = NO_NOTES) -> Estimate:
    """Turn the factors, transformed, into an estimate: oriented, unit normals, lights as direction and intensity.

    Args:
        prepared: What `prepare` returned.
        gbr: The method's bas-relief transformation of the prepared factors.
        notes: What the method notes besides `albedo` and `gbr`.
    """
    factors = orient(prepared.factors.transform(gbr), prepared.mask)
    strength = np.linalg.norm(factors.lights, axis=0)
    directions = (factors.lights / np.maximum(strength, 1e-12)).T
    directions[strength <= 0.0] = (0.0, 0.0, 1.0)
    to_map = prepared.observations.to_map
    return Estimate(
        normals=to_map(factors.normals()),
        light_directions=directions.astype(np.float32),
        intensities=scale_to_mean(strength).astype(np.float32),
        notes=replace(notes, albedo=to_map(factors.albedo()), gbr=(gbr.mu, gbr.nu, gbr.lam)),
    )
