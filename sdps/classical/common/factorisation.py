"""From images to pseudo-normals and pseudo-lights that lack only a bas-relief transformation.

Hayakawa (JOSA A 1994) factorises the images of a Lambertian object into B (P x 3) and S (3 x L); Yuille & Snow (CVPR
1997) and Belhumeur, Kriegman & Yuille (IJCV 1999) show that integrability leaves of the 3x3 ambiguity only `Gbr`. This
is the front end of the uncalibrated methods; each of them then finds the three numbers that are left.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from render.shared.errors import InputError
from sdps.classical.common.gbr import Gbr
from sdps.classical.common.outlines import outward_gradient, unit_normals

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
        singular: The largest singular values, (min(L, 6),) of the images or (3,) of B S alone, over the first.
    """

    surface: np.ndarray
    lights: np.ndarray
    singular: np.ndarray

    def transform(self, gbr: Gbr) -> "Factors":
        """Return the factors after a bas-relief transformation."""
        surface, lights = gbr.apply(self.surface, self.lights)
        return replace(self, surface=surface, lights=lights)

    def albedo(self) -> np.ndarray:  # (P,)
        """Return the length of every pseudo-normal."""
        return np.linalg.norm(self.surface, axis=1)

    def normals(self) -> np.ndarray:  # (P, 3)
        """Return unit vectors; (0, 0, 1) where the pseudo-normal is zero."""
        return unit_normals(self.surface)


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


def balance(surface: np.ndarray, lights: np.ndarray) -> Factors:
    """Return the factors of B S in which B's columns are orthogonal, of root mean square 1, and S's rows orthogonal.

    Args:
        surface: B, (P, 3).
        lights: S, (3, L).

    Raises:
        InputError: B has fewer than three dimensions.
    """
    scale = column_scale(surface)
    left, singular, right = np.linalg.svd(scale @ lights, full_matrices=False)
    surface = surface @ np.linalg.inv(scale) @ left
    return Factors(surface, singular[:, None] * right, singular / max(float(singular[0]), 1e-300))


def column_scale(surface: np.ndarray) -> np.ndarray:  # (3, 3)
    """Return R by which B (P, 3) exceeds orthogonal columns of root mean square 1: those of B R^-1.

    Raises:
        InputError: B has fewer than three dimensions.
    """
    scale = np.linalg.qr(surface, mode="r") / np.sqrt(len(surface))
    if not np.linalg.cond(scale) < 1e12:
        raise InputError(
            "the fit has fewer than three dimensions; the object is planar or cylindrical, or lights coplanar"
        )
    return scale


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
    outward = outward_gradient(mask, 1.5)
    total = float(np.abs(outward).sum())
    return float((normals[:, :2] * outward).sum() / total) if total > 0.0 else 0.0


def orient(factors: Factors, mask: np.ndarray) -> Factors:
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
