"""What a saved result says of how it shines: glTF's maps and mesh, and relightable pictures."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.images import quantise
from sdps.photos.response import display
from sdps.refinement.reflectance import MODES, SHAPES, shade
from sdps.surface.exports.map_files import write_picture
from sdps.surface.exports.saved_result import SavedResult
from sdps.surface.gloss.fitted_gloss import BRIGHTEST, Materials, Surface, fit_materials, match_photographs
from sdps.surface.gloss.relightable import (
    HARMONICS,
    expand_harmonics,
    expand_polynomial,
    fit_pictures,
    measure_error,
    spread_lights,
    write_ptm,
    write_rti,
)
from sdps.surface.gloss.textured_glb import Maps, write_textured_glb

MOST_PIXELS = 2**23
"""Of relightable pictures, which take 27 bytes a pixel, and 170 while they are made."""
_LIGHTS = 64  # of pictures relit from the refined reflectance
_WHITE = 99.5  # percentile of the pictures' values that is shown as white
_LOOKED_AT, _FEW = 8, 4000  # pictures and their pixels that this is measured on
Pictures = Callable[[], Iterator[np.ndarray]]


def write_materials(result: SavedResult, folder: Path) -> list[Path]:
    """Write baseColor.png (sRGB), roughness.png, metallic.png, and material.json, which tells how sure they are."""
    maps, found = _make_maps(result)
    about = folder / "material.json"
    made = [
        write_picture(folder / "baseColor.png", display(maps.base)),
        write_picture(folder / "roughness.png", quantise(maps.roughness, 8)),
        write_picture(folder / "metallic.png", quantise(maps.metallic, 8)),
    ]
    write_json(about, _describe(result, found))
    return [*made, about]


def write_gltf(result: SavedResult, folder: Path) -> list[Path]:
    """Write object.glb, the mesh with base colour, metallic, roughness and normals as pictures."""
    path = folder / "object.glb"
    maps, _ = _make_maps(result)
    write_textured_glb(path, maps, result.depth, result.mask, camera=result.camera, millimetres=result.pixel_size)
    return [path]


def write_relightable(kind: str, result: SavedResult, folder: Path) -> list[Path]:
    """Write object.ptm or object.rti, and what they were fitted to.

    Args:
        kind: `ptm` or `rti`.
        result: The result, with its photographs, or refined.
        folder: Where to.

    Raises:
        InputError: too few photographs, or none and nothing refined.
    """
    every = int(np.ceil(np.sqrt(result.mask.sum() / MOST_PIXELS)))
    chosen = np.zeros_like(result.mask)
    chosen[::every, ::every] = result.mask[::every, ::every]
    origin, lights, pictures = (_relit if result.pictures is None else _photographed)(result, chosen)
    terms = max((some for some in HARMONICS if 4 * some <= 3 * len(lights)), default=HARMONICS[0])
    basis = expand_polynomial(lights) if kind == "ptm" else expand_harmonics(lights, terms)
    numbers = fit_pictures(pictures(), basis)
    path, about = folder / f"object.{kind}", folder / f"{kind}.json"
    (write_ptm if kind == "ptm" else write_rti)(path, numbers, chosen[::every, ::every])
    error = measure_error(pictures(), basis, numbers)
    facts = {"of": origin, "lights": len(lights), "numbers": basis.shape[1], "rms_error": round(error, 4)}
    write_json(about, facts | {"every": every})
    return [path, about]


def read_surface(result: SavedResult) -> Surface:
    """Return the refined reflectance of the mask's pixels.

    Raises:
        InputError: nothing was refined, or by an earlier version.
    """
    facts = result.facts.get("refined")
    albedo, strength = result.albedo, result.highlights
    if not isinstance(facts, dict) or albedo is None or strength is None:
        raise InputError(
            f"{result.folder}: nothing was refined, so how it shines is not known; run `sdps infer --refine` again"
        )
    try:
        lobes = facts["lobes"]
        body, modes, amplitudes, sharpness, gains = (
            np.array(values, np.float64)
            for values in (facts["body"], facts["modes"], lobes["amplitudes"], lobes["sharpness"], facts["channels"])
        )
        if (body.shape, modes.shape, gains.shape) != ((SHAPES,), (MODES,), (3,)) or not gains.min() > 0.0:
            raise ValueError("numbers of another model")
        if amplitudes.ndim != 1 or amplitudes.shape != sharpness.shape:
            raise ValueError("lobes without sharpness")
        if albedo.shape != (*result.shape, 3) or strength.size != result.mask.size:
            raise ValueError(f"albedo {albedo.shape} and highlights {strength.shape} of a picture {result.shape}")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{result.folder / 'result.json'}: its reflectance is of an earlier version or damaged ({error}); "
            "run `sdps infer` again"
        ) from error
    strength = strength.reshape(result.shape)[result.mask]
    found = Surface(albedo[result.mask], strength, body, modes, amplitudes, sharpness, gains)
    if not all(np.isfinite(part).all() for part in found):
        raise InputError(f"{result.folder}: its reflectance is not finite; run `sdps infer` again")
    return found


def _make_maps(result: SavedResult) -> tuple[Maps, Materials]:
    """Return the pictures of a result, and the materials of its pixels."""
    surface = read_surface(result)
    found = fit_materials(surface)
    if result.lights is not None:
        found = match_photographs(found, surface, result.normals[result.mask], result.lights.directions)
    pictures = [np.zeros((*result.shape, *part.shape[1:]), np.float32) for part in found[:3]]
    for picture, part in zip(pictures, found[:3], strict=True):
        picture[result.mask] = part
    base, metallic, roughness = pictures
    return Maps(base, metallic, roughness, result.normals), found


def _describe(result: SavedResult, found: Materials) -> dict[str, Any]:
    """Say what the maps hold and what they rest on; JSON ready."""
    metal, facts = float(found.metallic.mean()), result.facts["refined"]
    scale = "highlights of a dielectric reflect 4 % head-on" if metal < 1.0 else "not known: a metal's highlights"
    return {
        "model": "glTF 2.0 metallic-roughness",
        "base_colour": f"sRGB; its scale: {scale}; its brightest percent is at most {BRIGHTEST}",
        "roughness": "linear, alpha = roughness^2",
        "metallic_share": round(metal, 4),
        "median_roughness": round(float(np.median(found.roughness)), 3),
        "refinement_doubt": facts.get("doubt", ""),
    }


def _photographed(result: SavedResult, chosen: np.ndarray) -> tuple[str, np.ndarray, Pictures]:
    """Return what is fitted, lights (L, 3), and what yields chosen pixels (n, 3) under equal lights."""
    if result.lights is None or not len(result.lights.directions):
        raise InputError(f"{result.folder}: no lights were found; use a method that finds them")
    known, source = result.lights, result.pictures
    assert source is not None
    gains = known.intensities.reshape(len(known.directions), -1).mean(axis=1)

    def read(number: int) -> np.ndarray:
        return np.asarray(source[number : number + 1])[0][chosen] / max(float(gains[number]), 1e-6)

    looked_at = range(0, len(gains), max(1, len(gains) // _LOOKED_AT))
    white = _find_white(read(number) for number in looked_at)
    return "photographs", known.directions, lambda: (read(number) / white for number in range(len(gains)))


def _relit(result: SavedResult, chosen: np.ndarray) -> tuple[str, np.ndarray, Pictures]:
    """Return the same of pictures relit from the refined reflectance, without cast shadows."""
    surface, lights, normals = read_surface(result), spread_lights(_LIGHTS), result.normals[chosen]
    kept = chosen[result.mask]
    surface = surface._replace(albedo=surface.albedo[kept], strength=surface.strength[kept])

    def relight(light: np.ndarray) -> np.ndarray:
        return shade(normals, light[None].astype(np.float32), surface)[..., 0] * surface.gains

    white = _find_white(relight(light) for light in lights[:: _LIGHTS // _LOOKED_AT])
    return "refined reflectance, without cast shadows", lights, lambda: (relight(light) / white for light in lights)


def _find_white(pictures: Iterator[np.ndarray]) -> float:
    """Return the value that is shown as white."""
    values = [picture[:: max(1, len(picture) // _FEW)] for picture in pictures]
    return max(float(np.percentile(np.concatenate(values), _WHITE)), 1e-9)
