"""What a saved result says of how it shines: glTF's maps and mesh, and relightable pictures."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.images import quantise
from sdps.core.geometry import Capture
from sdps.photos.response import display
from sdps.refinement.reflectance import MODES, SHAPES, shade
from sdps.surface.exports.map_files import write_picture
from sdps.surface.exports.saved_result import SavedResult
from sdps.surface.gloss.fitted_gloss import BRIGHTEST, Materials, Surface, fit_materials, match_photographs
from sdps.surface.gloss.pixel_lights import PixelLights
from sdps.surface.gloss.relightable import (
    HARMONICS,
    Expand,
    Pictures,
    expand_harmonics,
    expand_polynomial,
    fit_near_pictures,
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
_FITTED: WeakKeyDictionary[SavedResult, Materials] = WeakKeyDictionary()


def write_materials(result: SavedResult, folder: Path) -> list[Path]:
    """Write baseColor.png (sRGB), roughness.png, metallic.png, and material.json, which tells how sure they are."""
    found = _find_materials(result)
    maps = _make_maps(result, found)
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
    maps = _make_maps(result, _find_materials(result))
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
    count = len(lights.directions)
    terms = max((some for some in HARMONICS if 4 * some <= 3 * count), default=HARMONICS[0])
    expand: Expand = expand_polynomial if kind == "ptm" else partial(expand_harmonics, terms=terms)
    basis = expand(lights.directions)
    if lights.nearness is None:
        numbers = fit_pictures(pictures(), basis)
        error = measure_error(pictures(), basis, numbers)
    else:
        numbers = fit_near_pictures(pictures, expand, lights)
        error = measure_error(pictures(), basis, numbers, expand, lights)
    path, about = folder / f"object.{kind}", folder / f"{kind}.json"
    (write_ptm if kind == "ptm" else write_rti)(path, numbers, chosen[::every, ::every])
    facts = {"of": origin, "lights": count, "numbers": basis.shape[1], "rms_error": round(error, 4)}
    write_json(about, facts | {"every": every})
    return [path, about]


def read_surface(result: SavedResult) -> Surface:
    """Return the refined reflectance of the mask's pixels.

    Raises:
        InputError: nothing was refined, or by an earlier version.
    """
    facts = result.facts.get("refined")
    albedo, strength = result.albedo, result.highlights
    if isinstance(facts, dict) and strength is None and "light" in facts:
        raise InputError(
            f"{result.folder}: found under light from all around, which does not tell how it shines; photograph it "
            "under one lamp at a time"
        )
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


def _find_materials(result: SavedResult) -> Materials:
    """Return the materials of a result's pixels, fitted once for all exports that want them."""
    found = _FITTED.get(result)
    if found is None:
        surface = read_surface(result)
        found = fit_materials(surface)
        if result.lights is not None:
            lights = _see_lights(result, result.mask)
            found = match_photographs(found, surface, result.normals[result.mask], lights)
        _FITTED[result] = found
    return found


def _make_maps(result: SavedResult, found: Materials) -> Maps:
    """Return the materials as pictures."""
    pictures = [np.zeros((*result.shape, *part.shape[1:]), np.float32) for part in found[:3]]
    for picture, part in zip(pictures, found[:3], strict=True):
        picture[result.mask] = part
    base, metallic, roughness = pictures
    return Maps(base, metallic, roughness, result.normals)


def _see_lights(result: SavedResult, chosen: np.ndarray) -> PixelLights:
    """Return the lights of a result, which has some, as chosen pixels see them."""
    known, capture = result.lights, Capture.of(result.mask, result.camera)
    assert known is not None
    return PixelLights.of(capture, chosen, result.depth, known.directions, known.nearness)


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


def _photographed(result: SavedResult, chosen: np.ndarray) -> tuple[str, PixelLights, Pictures]:
    """Return what is fitted, the lights, and what yields chosen pixels (n, 3) as if each lamp shone on them alike."""
    if result.lights is None or not len(result.lights.directions):
        raise InputError(f"{result.folder}: no lights were found; use a method that finds them")
    known, source, lights = result.lights, result.pictures, _see_lights(result, chosen)
    assert source is not None
    gains = known.intensities.reshape(len(known.directions), -1).mean(axis=1)

    def read(number: int) -> np.ndarray:
        values = np.asarray(source[number : number + 1])[0][chosen] / max(float(gains[number]), 1e-6)
        return lights.even_out(values, number)

    looked_at = range(0, len(gains), max(1, len(gains) // _LOOKED_AT))
    white = _find_white(read(number) for number in looked_at)
    return "photographs", lights, lambda: (read(number) / white for number in range(len(gains)))


def _relit(result: SavedResult, chosen: np.ndarray) -> tuple[str, PixelLights, Pictures]:
    """Return the same of pictures relit from the refined reflectance, without cast shadows."""
    surface, directions, normals = read_surface(result), spread_lights(_LIGHTS), result.normals[chosen]
    kept, capture = chosen[result.mask], Capture.of(result.mask, result.camera)
    surface = surface._replace(albedo=surface.albedo[kept], strength=surface.strength[kept])
    lights = PixelLights.of(capture, chosen, result.depth, directions)

    def relight(light: np.ndarray) -> np.ndarray:
        seen, towards, _ = lights._replace(directions=light[None]).see(normals, slice(None))
        return shade(seen, towards.astype(np.float32), surface)[..., 0] * surface.gains

    white = _find_white(relight(light) for light in directions[:: _LIGHTS // _LOOKED_AT])
    return "refined reflectance, without cast shadows", lights, lambda: (relight(light) / white for light in directions)


def _find_white(pictures: Iterator[np.ndarray]) -> float:
    """Return the value that is shown as white."""
    values = [picture[:: max(1, len(picture) // _FEW)] for picture in pictures]
    return max(float(np.percentile(np.concatenate(values), _WHITE)), 1e-9)
