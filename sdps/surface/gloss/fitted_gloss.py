"""Base colour, metallic and roughness of glTF (`metallic_roughness`), fitted to the reflectance that refinement found.

Radiance f max(n . l, 0) of both is compared at 1900 directions of light, of surfaces at four tilts. For each pixel,
with the object's scale k (radiance of the photographs over that of glTF):

    dielectric   rho D + S  is  k ((1 - F) base + M_roughness), M the highlight of f0 = 0.04
    metal        rho D + S  is  k base P_roughness,             P the highlight of f0 = 1

Least squares gives base for every roughness, then roughness. k is what explains the highlights of most pixels as those
of a dielectric, whose f0 is known: so highlights tell how dark the base colour is. Where it would be brighter than
white, k is such that its brightest percent is 0.95.

What the model can tell of metals: its highlights have no colour, so a metal's is found in the lamps' colour, and given
back to it here as if they were white. An object is of metal if it would be blacker as a dielectric than black paint
(0.03) and a metal explains it better; in other objects, pixels whose highlights reflect five times as much as those of
a dielectric can are of metal.
"""

from typing import NamedTuple

import numpy as np

from render.shared.errors import InputError
from sdps.inference.tiles import split
from sdps.refinement.reflectance import evaluate_body, evaluate_factor, evaluate_lobes, measure_angles, shade
from sdps.surface.gloss.metallic_roughness import (
    DIELECTRIC,
    evaluate_fresnel,
    evaluate_highlight,
    measure_cosines,
)
from sdps.surface.gloss.pixel_lights import PixelLights

ROUGHNESS = np.linspace(0.05, 1.0, 58)
"""Tried one by one, with a parabola between them."""
BRIGHTEST = 0.95
"""Of base colour: no surface is brighter."""
BLACKEST = 0.03
"""Base colour that dielectrics hardly go below."""
METAL = 5.0 * DIELECTRIC
"""f0 from which on a pixel is of metal."""
_VIEWS, _TILTS = (0.98, 0.9, 0.75, 0.55), 40  # n . v, and angles of half vectors
_TRIED, _FIRST, _LAST = 160, 0.02, 5000.0  # scales, relative to photographs of mean 1
_FEW, _PART = 2000, 2**14
_FLOOR = 0.05
_MOST_LIGHTS = 32


class Surface(NamedTuple):
    """What refinement found of n pixels (`sdps.refinement.image_model.Refined`).

    Attributes:
        albedo: (n, 3) rho.
        strength: (n,) s.
        body, modes: (4,) and (M,).
        amplitudes, sharpness: (K,) of the lobes.
        gains: (3,) of the channels, the mean of the lamps' intensities.
    """

    albedo: np.ndarray
    strength: np.ndarray
    body: np.ndarray
    modes: np.ndarray
    amplitudes: np.ndarray
    sharpness: np.ndarray
    gains: np.ndarray


class Materials(NamedTuple):
    """glTF's materials of n pixels, float32.

    Attributes:
        base: (n, 3) linear base colour, 0 to 1.
        metallic: (n,) 0 or 1.
        roughness: (n,) 0.05 to 1.
        scale: Radiance of the photographs (of mean 1, under intensities of mean 1) over that of glTF.
    """

    base: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    scale: float


class _Shapes(NamedTuple):
    """Radiance at the sampled directions (N,), or for each roughness (R, N)."""

    body: np.ndarray
    lobes: np.ndarray
    matt: np.ndarray
    dielectric: np.ndarray
    mirror: np.ndarray


def fit_materials(surface: Surface) -> Materials:
    """Return the materials that reflect most like a refined surface.

    Raises:
        InputError: no pixels.
    """
    if not len(surface.albedo):
        raise InputError("the refined reflectance has no pixels; run `sdps infer` again")
    shapes = _sample(surface)
    few = slice(None, None, max(1, len(surface.albedo) // _FEW))
    grey, strength = _read_part(surface, few)
    apart = _apart_from_matt(shapes)
    scale = _find_scale(apart, grey, strength)
    off, roughness = _as_dielectric(apart, grey, strength, scale)
    plain = _base_colour(shapes, surface.albedo[few], strength, roughness, scale)
    better = _as_metal(shapes, grey, strength)[0].mean() < off.mean()
    if better and np.median(plain.mean(axis=1)) < BLACKEST:
        return _all_metal(shapes, surface)
    scale *= max(1.0, float(np.percentile(plain.max(axis=1), 99)) / BRIGHTEST)
    found = [_fit_part(shapes, apart, surface, some, scale) for some in split(len(surface.albedo), _PART)]
    base, metallic, roughness = (np.concatenate(values) for values in zip(*found, strict=True))
    return Materials(base, metallic, roughness, scale)


def _fit_part(shapes: _Shapes, apart: _Shapes, surface: Surface, some: slice, scale: float) -> tuple[np.ndarray, ...]:
    """Return base colour, metallic and roughness of some pixels, dielectrics or metal."""
    grey, strength = _read_part(surface, some)
    off, roughness = _as_dielectric(apart, grey, strength, scale)
    base = _base_colour(shapes, surface.albedo[some], strength, roughness, scale)
    metal_off, metal_roughness, reflected = _as_metal(shapes, grey, strength)
    metal = (reflected > METAL * scale) & (metal_off < off)
    coloured = reflected[:, None] * (surface.gains / surface.gains.max()) / scale
    base = np.where(metal[:, None], coloured, base)
    found = np.clip(base, 0.0, 1.0), metal, np.where(metal, metal_roughness, roughness)
    return tuple(values.astype(np.float32) for values in found)


def _all_metal(shapes: _Shapes, surface: Surface) -> Materials:
    """Return the materials of an object of metal, whose brightest percent is set to `BRIGHTEST`."""
    found = [_as_metal(shapes, *_read_part(surface, some))[1:] for some in split(len(surface.albedo), _PART)]
    roughness, reflected = (np.concatenate(values).astype(np.float32) for values in zip(*found, strict=True))
    scale = max(float(np.percentile(reflected, 99)), 1e-9) / BRIGHTEST
    colour = (surface.gains / surface.gains.max() / scale).astype(np.float32)
    return Materials(np.clip(reflected[:, None] * colour, 0.0, 1.0), np.ones_like(roughness), roughness, scale)


def _read_part(surface: Surface, some: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey albedo and the strength of some pixels, float64."""
    return surface.albedo[some].mean(axis=1, dtype=np.float64), surface.strength[some].astype(np.float64)


def _sample(surface: Surface) -> _Shapes:
    """Return what body, lobes and glTF's parts reflect, at half vectors up to 60 degrees from the normals."""
    normals, lights, weights = _directions()
    angles, cosines = measure_angles(normals, lights[:, None]), measure_cosines(normals, lights)
    lit = weights * (normals * lights).sum(axis=1)
    factor = evaluate_factor(angles, surface.modes)[:, 0] * lit
    lobes = evaluate_lobes(angles, np.ones(len(normals)), surface.amplitudes, surface.sharpness)[:, 0]
    fresnel = DIELECTRIC + (1.0 - DIELECTRIC) * evaluate_fresnel(cosines)
    mirror = np.stack([evaluate_highlight(cosines, roughness) * lit for roughness in ROUGHNESS])
    body = evaluate_body(angles, surface.body)[:, 0]
    return _Shapes(body * factor, lobes * factor, (1.0 - fresnel) * lit, mirror * fresnel, mirror)


def _directions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals and lights (N, 3), and weights (N,) with which the half vectors' angles count evenly: they are
    denser near the normals, so that none of the sharpest highlights falls between them.
    """
    share, turn = (np.arange(_TILTS) + 0.5) / _TILTS, np.radians(np.arange(0.0, 360.0, 15.0))
    tilt, turn = (grid.ravel() for grid in np.meshgrid(np.radians(60.0) * share**2, turn))
    every = np.sqrt(np.sqrt(tilt))  # least squares squares it: the spacing, which grows as the root of the angle
    normals, lights, weights = [], [], []
    for view in _VIEWS:
        normal, side = np.array([np.sqrt(1 - view**2), 0.0, view]), np.array([view, 0.0, -np.sqrt(1 - view**2)])
        around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.array([0.0, 1.0, 0.0])
        half = np.cos(tilt)[:, None] * normal + np.sin(tilt)[:, None] * around
        light = 2.0 * half[:, 2:] * half - np.array([0.0, 0.0, 1.0])
        usable = (half[:, 2] > 0.3) & (light @ normal > 0.1) & (light[:, 2] > 0.15)
        lights.append(light[usable])
        weights.append(every[usable])
        normals.append(np.broadcast_to(normal, lights[-1].shape))
    return np.concatenate(normals), np.concatenate(lights), np.concatenate(weights)


def _find_scale(apart: _Shapes, grey: np.ndarray, strength: np.ndarray) -> float:
    """Return the scale that explains the highlights of most pixels as those of dielectrics."""
    tried = np.geomspace(_FIRST, _LAST, _TRIED)
    wanted = _multiply(grey, strength, apart.body, apart.lobes)
    wanted += _FLOOR * wanted.mean() + 1e-12  # pixels count the same, but for those that hardly shine
    shares = (_as_dielectric(apart, grey, strength, scale)[0] / wanted for scale in tried)
    off = [np.sqrt(np.maximum(share, 0.0)).mean() for share in shares]  # not squared: an inlay must not decide
    return float(tried[int(np.argmin(off))])


def _as_dielectric(
    apart: _Shapes, grey: np.ndarray, strength: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the squares that the best dielectric leaves of each pixel, and its roughness; base is whatever fits."""
    both = np.outer(grey, apart.dielectric @ apart.body) + np.outer(strength, apart.dielectric @ apart.lobes)  # (n, R)
    off = scale**2 * (apart.dielectric**2).sum(axis=1) - 2 * scale * both
    return off.min(axis=1) + _multiply(grey, strength, apart.body, apart.lobes), _at_least(off)


def match_photographs(found: Materials, surface: Surface, normals: np.ndarray, lights: PixelLights) -> Materials:
    """Return materials whose base colour makes them, under the photographs' lights, most like the refined surface.

    Elsewhere a highlight that no photograph saw would count as much as what all of them saw.

    Args:
        found: Of `fit_materials`.
        surface: What it was fitted to.
        normals: (n, 3) unit, in the camera's frame.
        lights: Of the n pixels.
    """
    lights = lights.thin(-(-len(lights.directions) // _MOST_LIGHTS))
    parts = [_match_part(found, surface, normals, lights, some) for some in split(len(normals), _PART)]
    base, scale = np.concatenate(parts), found.scale
    if found.metallic.all():
        share = max(float(np.percentile(base.max(axis=1), 99)), 1e-9) / BRIGHTEST
        base, scale = base / share, scale * share
    return found._replace(base=np.clip(base, 0.0, 1.0).astype(np.float32), scale=scale)


def _match_part(
    found: Materials, surface: Surface, normals: np.ndarray, lights: PixelLights, some: slice
) -> np.ndarray:  # (n, 3)
    """Return the base colour of some pixels by least squares; radiance is linear in it."""
    turned, directions, falloff = lights.see(normals[some], some)
    metallic, roughness = found.metallic[some, None], found.roughness[some, None].astype(np.float64)
    own = surface._replace(albedo=surface.albedo[some], strength=surface.strength[some])
    wanted = shade(turned, directions.astype(np.float32), own) / found.scale  # (n, 3, L)
    wanted *= np.where(metallic > 0, surface.gains / surface.gains.max(), 1.0)[..., None]
    cosines = measure_cosines(turned[:, None], directions)
    lit = turned @ directions.T if falloff is None else (turned[:, None] * directions).sum(axis=-1)
    lit = np.clip(lit, 0.0, None)
    fresnel, mirror = evaluate_fresnel(cosines), evaluate_highlight(cosines, roughness) * lit
    f0 = np.where(metallic > 0, 0.0, DIELECTRIC)
    fixed = (f0 + (1.0 - f0) * fresnel) * mirror
    moves = np.where(metallic > 0, (1.0 - fresnel) * mirror, (1.0 - f0) * (1.0 - fresnel) * lit)  # times base
    weighted = moves if falloff is None else moves * falloff**2  # as bright as the photographs show them
    left = ((wanted - fixed[:, None]) * weighted[:, None]).sum(axis=-1)
    return np.maximum(left / np.maximum((moves * weighted).sum(axis=1), 1e-9)[:, None], 0.0)


def _as_metal(shapes: _Shapes, grey: np.ndarray, strength: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the squares that the best metal leaves of each pixel, its roughness, and k base."""
    both = np.outer(grey, shapes.mirror @ shapes.body) + np.outer(strength, shapes.mirror @ shapes.lobes)
    own = (shapes.mirror**2).sum(axis=1)
    off = -(both**2) / own
    best = off.argmin(axis=1)
    reflected = both[np.arange(len(best)), best] / own[best]
    return off.min(axis=1) + _multiply(grey, strength, shapes.body, shapes.lobes), _at_least(off), reflected


def _apart_from_matt(shapes: _Shapes) -> _Shapes:
    """Return what is left when any base colour may explain what it can."""
    matt = shapes.matt / np.linalg.norm(shapes.matt)
    return _Shapes(*(part - (part @ matt)[..., None] * matt for part in shapes))


def _multiply(grey: np.ndarray, strength: np.ndarray, body: np.ndarray, lobes: np.ndarray) -> np.ndarray:  # (n,)
    """Return the squares of rho body + s lobes."""
    return grey**2 * (body @ body) + 2 * grey * strength * (body @ lobes) + strength**2 * (lobes @ lobes)


def _base_colour(
    shapes: _Shapes, albedo: np.ndarray, strength: np.ndarray, roughness: np.ndarray, scale: float
) -> np.ndarray:  # (n, 3)
    """Return the base colour of dielectrics of that roughness."""
    body, lobes = shapes.body @ shapes.matt, shapes.lobes @ shapes.matt
    own = np.interp(roughness, ROUGHNESS, shapes.dielectric @ shapes.matt)
    left = (strength * lobes - scale * own)[:, None]
    return np.maximum(albedo * body + left, 0.0) / (scale * (shapes.matt @ shapes.matt))


def _at_least(off: np.ndarray) -> np.ndarray:  # (n,)
    """Return the roughness at the least of each row (n, R), between the three lowest by a parabola."""
    middle = np.clip(off.argmin(axis=1), 1, len(ROUGHNESS) - 2)
    rows = np.arange(len(off))
    left, here, right = (off[rows, middle + step] for step in (-1, 0, 1))
    bend = left - 2 * here + right
    shift = np.where(bend > 0, 0.5 * (left - right) / np.where(bend > 0, bend, 1.0), 0.0)
    step = ROUGHNESS[1] - ROUGHNESS[0]
    at_edge = off.argmin(axis=1) != middle
    shift = np.where(at_edge, off.argmin(axis=1) - middle, np.clip(shift, -1.0, 1.0))
    return np.clip(ROUGHNESS[middle] + step * shift, ROUGHNESS[0], ROUGHNESS[-1])
