"""What the page shows of an object: small arrays from which the browser makes pictures under any light.

Pictures are thinned to at most 384 pixels a side. Everything is in the frame x right, y up, z to the camera.
"""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from pipelines.app.pages.reflectance_tables import build_tables
from pipelines.evaluate.report.photographs_page import depth_picture
from pipelines.shared import pictures
from render.shared.progress import stage
from sdps.core.geometry import Capture
from sdps.core.intensities import grey
from sdps.refinement.reflectance import shade
from sdps.refinement.sites import place_sites, see
from sdps.surface.meshing import mesh, write_mesh

if TYPE_CHECKING:
    from sdps.surface.inferred import Inference

SIDE = 384
_MESH_SIDE = 512
_FULL = 65535
_LOBES = ("amplitudes", "sharpness", "body", "modes")


def write(result: "Inference", folder: Path) -> dict[str, Any]:
    """Write pictures, a mesh and arrays of an inference, and return what the page has to know of them.

    `basis.bin` holds little-endian int16 normals (h, w, 3), n * 32767, uint16 albedo (h, w, 3) and highlight strength
    (h, w), each over its largest value in the description; `tables.bin`, of a refined object, what `build_tables`
    returns; `observed.npy` (h, w, L) float16 the grey photographs and `model.npy` what explains them.
    """
    mask, normals = result.photos.mask, result.normals
    step = -(-max(mask.shape) // SIDE)
    few = (slice(None, None, step), slice(None, None, step))
    albedo, strength, lobes = _reflectance(result)
    scale = 0.9 / max(float(np.percentile(albedo[mask], 99)), 1e-9)
    peak, shine = float(albedo.max()) or 1.0, float(strength.max()) or 1.0
    unit = np.where(mask[few][..., None], normals[few], 0.0)
    parts = [
        np.rint(unit * 32767).astype("<i2"), np.rint(albedo[few] / peak * _FULL).astype("<u2"),
        np.rint(strength[few] / shine * _FULL).astype("<u2"),
    ]  # fmt: skip
    (folder / "basis.bin").write_bytes(b"".join(part.tobytes() for part in parts))
    tables = None
    if lobes:
        tables, values = build_tables(lobes)
        (folder / "tables.bin").write_bytes(values)
    height, width = mask[few].shape
    Image.fromarray(pictures.normal_map(normals, mask)).save(folder / "normals.png")
    Image.fromarray(depth_picture(result)).save(folder / "depth.png")
    _mesh(result, folder / "mesh.ply")
    stage("surface", 1, 2)
    _observations(result, few, unit, albedo[few], strength[few], lobes, folder)
    facts = result.summary()
    found = bool(len(result.light_directions))
    confidence = facts.get("light_confidence", {})
    return {
        "verdict": result.verdict, "method": result.method, "seconds": facts["seconds"], "terms": facts["terms"],
        "width": width, "height": height, "step": step, "full": [mask.shape[1], mask.shape[0]], "albedo": peak * scale,
        "strength": shine * scale if lobes else 0.0, "tables": tables, "files": list(result.photos.files),
        "lights": np.round(result.light_directions, 5).tolist() if found else [],
        "intensities": grey(result.gains).round(4).tolist() if found else [],
        "confidence": [confidence[name] for name in result.photos.files] if confidence else [],
        "components": result.depth.components, "integrability": facts["depth"]["residual_degrees"],
        "residual": facts.get("lambertian_residual"), "camera": facts["camera"],
        "expected": facts.get("expected_normal_error_degrees"),
        "lamps": facts["lamps"]["text"],
        "distances": [] if facts["lamps"]["far"] else _round_distances(result.lamp_distances),
    }  # fmt: skip


def shade_object(
    normals: np.ndarray, albedo: np.ndarray, strength: np.ndarray, lobes: dict[str, list[float]], light: np.ndarray
) -> np.ndarray:  # (h, w, 3)
    """Return the radiance under a light of intensity 1: Lambert's law, or `sdps.refinement.reflectance`.

    Args:
        normals: (h, w, 3), zero outside the object.
        albedo: (h, w, 3).
        strength: (h, w) of the highlights.
        lobes: `amplitudes`, `sharpness`, `body` and `modes` of a refined object; empty for Lambert's law.
        light: (3,) unit, or (h, w, 3), that of each pixel.
    """
    if not lobes:
        cosines = normals @ light if light.ndim == 1 else (normals * light).sum(axis=-1)
        return albedo * np.maximum(cosines, 0.0)[..., None]
    numbers = {name: np.array(values) for name, values in lobes.items()}
    surface = SimpleNamespace(albedo=albedo.reshape(-1, 3), strength=strength.reshape(-1), **numbers)
    lights = light[None] if light.ndim == 1 else light.reshape(-1, 1, 3)
    return shade(normals.reshape(-1, 3), lights, surface).reshape(albedo.shape)


def _round_distances(distances: np.ndarray) -> list[float | None]:
    """Return distances (L,) as the page has them; None for far away."""
    return [None if np.isinf(distance) else round(float(distance), 2) for distance in distances]


def _reflectance(result: "Inference") -> tuple[np.ndarray, np.ndarray, dict[str, list[float]]]:
    """Return albedo (H, W, 3), strength of highlights (H, W) and lobes; grey and matt where no lights were found."""
    found = result.refinement
    if found is not None and not found.trust.doubt:
        lobes = {name: getattr(found.refined, name).astype(float).tolist() for name in _LOBES}
        return found.refined.albedo, found.refined.strength, lobes
    albedo = result.albedo
    if albedo is None:
        albedo = np.repeat(result.photos.mask[..., None], 3, -1).astype(np.float32)
    return albedo, np.zeros(albedo.shape[:2], np.float32), {}


def _observations(
    result: "Inference", few: tuple[slice, slice], normals: np.ndarray, albedo: np.ndarray, strength: np.ndarray,
    lobes: dict[str, list[float]], folder: Path,
) -> None:  # fmt: skip
    """Write what every shown pixel measures in every photograph, and what the model says it should."""
    count = len(result.photos)
    observed = np.stack([grey(result.photos.window(slice(k, k + 1), *few)[0]) for k in range(count)], axis=-1)
    np.save(folder / "observed.npy", observed.astype(np.float16))
    if not len(result.light_directions):
        return
    gains = grey(result.gains)
    model = np.stack(
        [gain * falloff * grey(shade_object(turned, albedo, strength, lobes, light))
         for gain, (turned, light, falloff) in zip(gains, _see_lamps(result, few, normals), strict=True)], axis=-1,
    )  # fmt: skip
    scale = float((observed * model).sum() / max(float((model**2).sum()), 1e-12))
    np.save(folder / "model.npy", (scale * model).astype(np.float16))


def _see_lamps(
    result: "Inference", few: tuple[slice, slice], normals: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | float]]:
    """Yield normals (h, w, 3), light (3,) or (h, w, 3) and falloff (h, w) or 1 of each lamp; lines of sight are z."""
    photos, lamps = result.photos, result.near_lamps
    lights = result.light_directions.astype(np.float64)
    if lamps is None and not photos.camera.is_perspective:
        yield from ((normals, light, 1.0) for light in lights)
        return
    capture, mask, shape = Capture.of(photos.mask, photos.camera), photos.mask, normals.shape[:2]
    sides = (np.arange(side)[part] for side, part in zip(mask.shape, few, strict=True))
    rows, columns = (index.ravel() for index in np.meshgrid(*sides, indexing="ij"))
    inside = mask[few].ravel()
    sites = place_sites(capture, rows, columns, np.where(inside, result.depth.z[few].ravel(), 0.0))
    sites.places[~torch.from_numpy(inside)] = 0.0  # where a near lamp might stand
    nearness = torch.zeros(len(lights)) if lamps is None else torch.from_numpy(lamps.nearness)
    flat = torch.from_numpy(normals.reshape(-1, 3).astype(np.float32))
    for light, near in zip(torch.from_numpy(lights.astype(np.float32)), nearness, strict=True):
        seen = see(flat, light[None], near[None], sites)
        assert seen.gain is not None  # since there are sites
        turned, towards = (values.numpy().reshape(*shape, 3) for values in (seen.normals, seen.directions))
        yield turned, towards, 1.0 / seen.gain.numpy().reshape(shape)


def _mesh(result: "Inference", path: Path) -> None:
    """Write the surface as a PLY file of at most 512 pixels a side."""
    mask, z = result.depth.mask, result.depth.z
    step = -(-max(mask.shape) // _MESH_SIDE)
    few = (slice(None, None, step), slice(None, None, step))
    albedo = result.albedo
    colour = None
    if albedo is not None:
        colour = pictures.tone_map(albedo[few] / max(float(np.percentile(albedo[mask], 99)), 1e-9))
    camera = result.depth.camera.thin(mask.shape, step)
    write_mesh(mesh(z[few] / step, mask[few], camera=camera, colour=colour, normals=result.normals[few]), path)
