"""From images to pseudo-normals and pseudo-lights that lack only a bas-relief transformation.

Hayakawa (JOSA A 1994) factorises the images of a Lambertian object into B (P x 3) and S (3 x L); Yuille & Snow (CVPR
1997) and Belhumeur, Kriegman & Yuille (IJCV 1999) show that integrability leaves of the 3x3 ambiguity only `Gbr`. This
is the front end of the uncalibrated methods; each of them then finds the three numbers that are left.
"""

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage, optimize

from render.errors import InputError
from sdps.classical.gbr import Gbr
from sdps.classical.observations import Observations, observe
from sdps.classical.rpca import robust_low_rank
from sdps.classical.shadows import fit_lit
from sdps.estimate import Estimate

_log = logging.getLogger(__name__)

_NO_RANK = 1e-3
"""Third singular value over the first below which the images have no third dimension at all."""

_WEAK = 2.0
"""Third singular value over the fourth below which shading no longer stands out of highlights, shadows and noise."""


@dataclass(frozen=True, eq=False)
class Factors:
    """A factorisation I = B S.

    Attributes:
        surface: B, (P, 3) float64: albedo times normal, up to the ambiguity.
        lights: S, (3, L) float64: intensity times direction, up to the inverse ambiguity.
        singular: The largest singular values of the images, (min(L, 6),), over the first.
    """

    surface: np.ndarray
    lights: np.ndarray
    singular: np.ndarray

    def transformed(self, gbr: Gbr) -> "Factors":
        """Return the factors after a bas-relief transformation."""
        surface, lights = gbr.apply(self.surface, self.lights)
        return replace(self, surface=surface, lights=lights)

    def albedo(self) -> np.ndarray:  # (P,)
        """Return the length of every pseudo-normal."""
        return np.linalg.norm(self.surface, axis=1)

    def normals(self) -> np.ndarray:  # (P, 3)
        """Return unit vectors; (0, 0, 1) where the pseudo-normal is zero."""
        albedo = self.albedo()
        return np.where(albedo[:, None] > 0.0, self.surface / np.maximum(albedo, 1e-300)[:, None], [0.0, 0.0, 1.0])


def factorise(profiles: np.ndarray) -> Factors:
    """Factorise images into three dimensions by singular values (Hayakawa 1994, eq. 5).

    Args:
        profiles: (P, L), one intensity profile per row.

    Raises:
        InputError: fewer than three dimensions: a planar or cylindrical object, or coplanar lights. A weak third one
            draws a warning.
    """
    if min(profiles.shape) < 3:
        raise InputError(f"factorisation needs at least 3 images and 3 pixels, got {profiles.shape[::-1]}")
    gram_values, gram_vectors = np.linalg.eigh(profiles.T @ profiles)  # rows outnumber columns by far
    singular = np.sqrt(np.maximum(gram_values[::-1], 0.0))
    relative = singular / max(float(singular[0]), 1e-300)
    fourth = float(relative[3]) if len(relative) > 3 else 0.0
    if relative[2] < max(_NO_RANK, 1.1 * fourth if relative[2] < 0.02 else 0.0):
        raise InputError(
            f"the images have fewer than three dimensions (singular values 1 : {relative[1]:.2g} : {relative[2]:.2g}); "
            "the object is planar or cylindrical, or the lights lie in one plane"
        )
    if relative[2] < _WEAK * fourth:
        _log.warning(
            "the third singular value (%.3f of the first) hardly exceeds the fourth (%.3f): highlights, shadows or "
            "near-coplanar lights hide the shading; expect large errors", relative[2], fourth,
        )  # fmt: skip
    basis = gram_vectors[:, ::-1][:, :3]  # (L, 3)
    scale = np.sqrt(len(profiles))  # keeps pseudo-normals of order one whatever the number of pixels
    lights = (singular[:3, None] / scale) * basis.T
    surface = profiles @ basis / singular[:3] * scale
    return Factors(surface=surface, lights=lights, singular=relative[:6])


def impose_integrability(factors: Factors, mask: np.ndarray, *, smoothing: float = 1.0) -> Factors:
    """Reduce the ambiguity to a bas-relief transformation (Yuille & Snow 1997; Belhumeur et al. 1999, sec. 3).

    A surface's slopes b1/b3 and b2/b3 satisfy d/dy(b1/b3) = d/dx(b2/b3). With B = E A, that is linear in the first two
    rows of A^-1, found as the smallest singular vector of six columns. The third row is free; here it is the
    normalised cross product of the two, which keeps lambda of order one.

    Args:
        factors: A factorisation.
        mask: (H, W) bool.
        smoothing: Standard deviation, in pixels, of the Gaussian applied before differentiation.

    Raises:
        InputError: an object too small or narrow to differentiate, or whose slopes do not vary.
    """
    # Integrability does not change when all three maps are divided by one common map: that removes most albedo.
    values = factors.surface / np.maximum(factors.albedo(), 1e-12)[:, None]
    maps = np.zeros((*mask.shape, 3))
    maps[mask] = values
    if smoothing > 0.0:
        maps = np.stack([ndimage.gaussian_filter(maps[..., i], smoothing) for i in range(3)], axis=-1)
        weight = ndimage.gaussian_filter(mask.astype(float), smoothing)
        maps /= np.maximum(weight, 1e-6)[..., None]
    # A Gaussian window that reaches over the edge is one-sided, and its derivatives are biased.
    depth = ndimage.distance_transform_cdt(np.pad(mask, 1), metric="taxicab")[1:-1, 1:-1]
    margin = max(2, round(3.0 * smoothing))
    inner = depth > (margin if (depth > margin).sum() >= 12 else 2)
    if inner.sum() < 12:
        raise InputError(f"the mask has only {int(inner.sum())} pixels away from its edge; too few to differentiate")
    along_x = np.gradient(maps, axis=1)[inner]
    along_y = -np.gradient(maps, axis=0)[inner]  # rows go down, y goes up
    values = maps[inner]
    pairs = ((1, 2), (2, 0), (0, 1))
    columns = [values[:, i] * along_x[:, j] - values[:, j] * along_x[:, i] for i, j in pairs]
    columns += [values[:, i] * along_y[:, j] - values[:, j] * along_y[:, i] for i, j in pairs]
    system = np.stack(columns, axis=1)  # (P', 6)
    spread, vectors = np.linalg.eigh(system.T @ system)
    if spread[1] <= 1e-9 * spread[-1]:
        raise InputError("integrability does not fix the surface: its slopes vary along one direction only")
    first, second = vectors[:3, 0], vectors[3:, 0]
    third = np.cross(first, second)
    length = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
    inverse = np.stack([first, second, third / max(np.linalg.norm(third), 1e-300) * length])
    if np.linalg.cond(inverse) > 1e6:
        raise InputError("integrability leaves a singular ambiguity; the object is too flat for an uncalibrated method")
    return replace(factors, surface=factors.surface @ np.linalg.inv(inverse), lights=inverse @ factors.lights)


def outward_score(normals: np.ndarray, mask: np.ndarray) -> float:
    """Return how far normals (P, 3) lean out of the object's contour on average: positive on a convex object.

    Contour pixels at the image's frame do not count; what lies behind them is unknown.
    """
    soft = ndimage.gaussian_filter(np.pad(mask, 4, mode="edge").astype(float), 1.5)[4:-4, 4:-4]
    outward = np.stack([-np.gradient(soft, axis=1), np.gradient(soft, axis=0)], axis=-1)[mask]  # (P, 2), y up
    total = float(np.abs(outward).sum())
    return float((normals[:, :2] * outward).sum() / total) if total > 0.0 else 0.0


def oriented(factors: Factors, mask: np.ndarray) -> Factors:
    """Decide between convex and concave, and turn the normals to the camera.

    (B, S) and (-B, -S) give the same images, and so does the sign of lambda: one is fixed by the contour, along which
    a solid's normals lean outwards, the other by visibility, which asks for positive z.
    """
    normals = factors.normals()
    score = outward_score(normals, mask)
    if abs(score) < 0.02:
        _log.warning("the contour does not tell convex from concave; the relief may be inverted")
    sign = np.sign(score) or 1.0
    depth = np.sign((sign * normals[:, 2]).mean()) or 1.0
    flip = sign * np.array([1.0, 1.0, depth])
    return replace(factors, surface=factors.surface * flip, lights=flip[:, None] * factors.lights)


@dataclass(frozen=True, eq=False)
class Prepared:
    """The state in which an uncalibrated method starts.

    Attributes:
        observations: The images at the object's pixels.
        profiles: (P, L) grey intensity profiles as they are.
        cleaned: (P, L) after the robust low-rank step; `profiles` without it.
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


def prepare(
    images: np.ndarray, mask: np.ndarray, *, robust: bool = True, smoothing: float = 1.0, minimum: int = 4
) -> Prepared:
    """Run the shared front end: check, clean, factorise, make integrable, orient.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        robust: Take highlights out by `robust_low_rank` first, and leave shadows out of the fit (`fit_lit`).
        smoothing: See `impose_integrability`.
        minimum: Fewest images the method can work with.

    Raises:
        InputError: degenerate input; see `observe`, `factorise`, `impose_integrability`.
    """
    observations = observe(images, mask, minimum=minimum)
    profiles = observations.grey()
    cleaned = robust_low_rank(profiles, progress=True) if robust else profiles
    factors = factorise(cleaned)
    if robust:
        surface, lights = fit_lit(profiles, cleaned, factors.lights)
        factors = replace(factors, surface=surface, lights=lights)
    factors = impose_integrability(factors, observations.mask, smoothing=smoothing)
    return Prepared(observations, profiles, cleaned, oriented(factors, observations.mask))


def conclude(prepared: Prepared, factors: Factors, diagnostics: dict[str, Any] | None = None) -> Estimate:
    """Turn resolved factors into an estimate: oriented, normals of length 1, lights split into direction and intensity.

    Args:
        prepared: What `prepare` returned.
        factors: Factors after the method's bas-relief transformation.
        diagnostics: What the method adds to `albedo` (H, W), and `singular_values`.
    """
    factors = oriented(factors, prepared.mask)
    strength = np.linalg.norm(factors.lights, axis=0)
    directions = (factors.lights / np.maximum(strength, 1e-12)).T
    directions[strength <= 0.0] = (0.0, 0.0, 1.0)
    to_map = prepared.observations.to_map
    return Estimate(
        normals=to_map(factors.normals()),
        light_directions=directions.astype(np.float32),
        intensities=(strength / max(float(strength.mean()), 1e-300)).astype(np.float32),
        diagnostics={"albedo": to_map(factors.albedo()), "singular_values": factors.singular} | (diagnostics or {}),
    )


def factorisation(images: np.ndarray, mask: np.ndarray, *, robust: bool = True) -> Estimate:
    """Stop at integrability and take the bas-relief transformation of equal light intensities.

    The plain rival of the methods that resolve the ambiguity: of all members of the group, the one under which the
    intensities of the lights vary least (Hayakawa 1994, sec. 4, restricted to the group). That is right where lights
    are equally strong.

    Args:
        images: (L, H, W, 3) or (L, H, W), linear radiance.
        mask: (H, W) bool.
        robust: See `prepare`.

    Raises:
        InputError: degenerate input; see `prepare`.
    """
    prepared = prepare(images, mask, robust=robust)
    gbr = equal_intensity(prepared.factors)
    return conclude(prepared, prepared.factors.transformed(gbr), {"gbr": (gbr.mu, gbr.nu, gbr.lam)})


def equal_intensity(factors: Factors) -> Gbr:
    """Return the transformation under which all lights are as equally strong as can be.

    The spread of log |G^-1 s| is minimised from several depth scales; lambda stays within [1/8, 8].
    """

    def spread(parameters: np.ndarray) -> np.ndarray:  # (L,)
        gbr = Gbr(parameters[0], parameters[1], float(np.exp(parameters[2])))
        strength = np.log(np.maximum(np.linalg.norm(gbr.lights(factors.lights), axis=0), 1e-12))
        return strength - strength.mean()

    limit = np.array([8.0, 8.0, np.log(8.0)])
    starts = [np.array([0.0, 0.0, start]) for start in (-0.7, 0.0, 0.7)]
    found = [optimize.least_squares(spread, start, bounds=(-limit, limit)) for start in starts]
    mu, nu, depth = min(found, key=lambda item: item.cost).x
    return Gbr(float(mu), float(nu), float(np.exp(depth)))
