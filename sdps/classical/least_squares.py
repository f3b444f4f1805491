"""Calibrated least squares (Woodham 1980): Lambert's law solved per pixel under known lights."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from render.shared.errors import InputError
from sdps.classical.common.near_lamps import NearLamps
from sdps.classical.common.observations import REC601, Observations, observe
from sdps.classical.common.outlines import MIN_CONDITION, unit_normals
from sdps.classical.common.weighted import solve_weighted
from sdps.core.estimate import NO_NOTES, Estimate, Notes
from sdps.core.intensities import grey

_CHUNK_VALUES = 2_000_000
"""Observations solved at a time: 16 MB per float64 array of them, however large the object."""


def least_squares(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    near: NearLamps | None = None,
    shadow_threshold: float = 0.0,
) -> Estimate:
    """Solve i_k = rho max(n . l_k, 0) in the least-squares sense for every pixel of the mask.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        light_directions: (L, 3), unit, from the surface to the light.
        intensities: (L,) or (L, 3) known intensities; equal ones when absent.
        near: How near the lamps stand, with the pixels' places (H, W, 3); None: they are distant. Directions and
            intensities are then those at the object's middle.
        shadow_threshold: Observations below this share of the pixel's brightest are taken for shadows and
            dropped, as long as three remain (0: keep all; 0.05 to 0.1 is usual).

    Returns:
        Normals; the given lights; note `albedo`, relative to a white Lambertian surface when the intensities are
        absolute.

    Raises:
        InputError: fewer than three images, lights that are coplanar or zero, an empty mask, images that are black or
            all alike, non-finite values, or sizes that differ.
    """
    if not 0.0 <= shadow_threshold < 1.0:
        raise InputError(f"shadow_threshold must be in [0, 1), got {shadow_threshold}")
    known = calibrate(images, mask, light_directions, intensities, near=near)
    vectors = known.solve_plain(known.profiles)
    if shadow_threshold > 0.0:
        vectors = known.in_chunks(
            lambda directions, profiles, start: solve_weighted(
                directions, profiles, profiles >= shadow_threshold * profiles.max(1, keepdims=True), start
            ),
            vectors,
        )
    return known.conclude(vectors)


Solver = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Vectors (n, 3) of directions (L, 3) or (n, L, 3), profiles (n, L) and where to start (n, 3)."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The state in which a calibrated method starts.

    Attributes:
        observations: The images at the object's pixels.
        profiles: (P, L) float64, grey under lights of intensity 1, at the pixel.
        directions: (L, 3) float64, unit.
        intensities: (L, 1) or (L, 3) float64.
        near: How near the lamps stand, with the pixels' places (P, 3); None: they are distant.
    """

    observations: Observations
    profiles: np.ndarray
    directions: np.ndarray
    intensities: np.ndarray
    near: NearLamps | None = None

    def in_chunks(self, solve: Solver, start: np.ndarray) -> np.ndarray:
        """Return `solve(directions, profiles, start)` of all pixels in flat memory; directions are (L, 3), or (n, L, 3)
        of near lamps, `start` and the result (P, 3).
        """
        parts = _split(*self.profiles.shape)
        return np.concatenate([solve(self._directions_at(part), self.profiles[part], start[part]) for part in parts])

    def solve_plain(self, profiles: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:  # (n, 3)
        """Return the least-squares vectors of profiles (n, L) with all observations.

        Args:
            profiles: Of all pixels, or of `pixels`.
            pixels: (n,) their numbers.
        """
        if self.near is None:
            return profiles @ np.linalg.pinv(self.directions).T
        pixels = np.arange(len(profiles)) if pixels is None else pixels
        parts = _split(*profiles.shape)
        return np.concatenate([_solve_near(self._directions_at(pixels[part]), profiles[part]) for part in parts])

    def _directions_at(self, pixels: np.ndarray | slice) -> np.ndarray:
        """Return directions (L, 3), or (n, L, 3) of near lamps at some pixels."""
        return self.directions if self.near is None else self.near.at(pixels).reach(self.directions)[0]

    def conclude(self, vectors: np.ndarray, notes: Notes = NO_NOTES) -> Estimate:
        """Turn vectors (P, 3), albedo times normal, into an estimate with the given lights."""
        albedo = np.linalg.norm(vectors, axis=1)
        to_map = self.observations.to_map
        return Estimate(
            normals=to_map(unit_normals(vectors)),
            light_directions=self.directions.astype(np.float32),
            intensities=grey(self.intensities).astype(np.float32),
            notes=replace(notes, albedo=to_map(albedo)),
        )


def calibrate(
    images: np.ndarray,
    mask: np.ndarray,
    light_directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    near: NearLamps | None = None,
    weights: tuple[float, float, float] = REC601,
    minimum: int = 3,
) -> Calibrated:
    """Check images and lights, and divide out the intensities; errors as in `least_squares`.

    Args:
        images, mask, light_directions, intensities, near: As for `least_squares`.
        weights: What R, G and B contribute to grey.
        minimum: Fewest images the method can work with.
    """
    observations = observe(images, mask, minimum=minimum)
    count, channels = observations.count, observations.values.shape[-1]
    directions = np.asarray(light_directions, np.float64)
    intensities = np.ones(count) if intensities is None else np.asarray(intensities, np.float64)
    if directions.shape != (count, 3) or len(intensities) != count:
        raise InputError(f"{count} images need {count} light directions and intensities, got {directions.shape}")
    intensities = intensities[:, None] if intensities.ndim == 1 else intensities  # (L, 1 or 3)
    if intensities.shape not in ((count, 1), (count, channels)):
        raise InputError(f"intensities of shape {intensities.shape} do not fit images of {channels} channel(s)")
    if not (np.isfinite(directions).all() and np.isfinite(intensities).all()):
        raise InputError("light directions or intensities contain NaN or infinite values; repair them first")
    if (intensities <= 0.0).any():
        raise InputError("light intensities must be positive")
    if not directions.any(axis=1).all():
        raise InputError("a light direction is (0, 0, 0); give vectors from the surface to the light")
    singular = np.linalg.svd(directions, compute_uv=False)
    if singular[2] < MIN_CONDITION * singular[0]:
        raise InputError("the light directions are coplanar; three that are not are needed")
    shares = np.array(weights if channels == 3 else (1.0,)) / intensities  # (L, C)
    profiles = np.einsum("lpc,lc->pl", observations.values, shares, optimize=True)
    profiles = np.ascontiguousarray(profiles)
    if near is None:
        return Calibrated(observations, profiles, directions, intensities)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    near = near.at(observations.mask)
    for part in _split(*profiles.shape):
        profiles[part] /= near.at(part).reach(directions)[1]
    return Calibrated(observations, profiles, directions, intensities, near)


def _split(pixels: int, count: int) -> list[slice]:
    """Return parts of the pixels whose observations fit into flat memory."""
    step = max(_CHUNK_VALUES // count, 1)
    return [slice(begin, begin + step) for begin in range(0, pixels, step)]


def _solve_near(directions: np.ndarray, profiles: np.ndarray) -> np.ndarray:  # (n, 3)
    """Return the least-squares vectors of profiles (n, L) under directions (n, L, 3); zero where these are coplanar."""
    return solve_weighted(directions, profiles, np.ones(profiles.shape), np.zeros((len(profiles), 3)))
