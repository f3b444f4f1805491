"""Refine normals under any light: each image is lit from all around, by harmonics up to order two; no more is known.

Light and albedo are found in closed form (`light_fit`) while the normals descend on the robust misfit; what the object
hides of the light is traced on the surface that the normals integrate to (`hidden`). Photographs under light of order
one determine normals only up to a linear map (Basri, Jacobs & Kemelmacher, IJCV 2007), and a wrong model of the
reflectance bends them; so normals stay near the start, the more the worse the model fits there, and are held to be
those of a surface. First on a coarse grid, then on every pixel, a tile at a time, under the light that was found.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, pi

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.progress import stage
from render.shared.seeds import spread_evenly
from sdps.core.geometry import ORTHOGRAPHIC, Camera, Capture
from sdps.inference.image_source import ImageSource, ObjectImages, survey
from sdps.inference.tiles import Tile, release_memory, tiles
from sdps.refinement.fine import make_interpolator
from sdps.refinement.problems import allocate, check_start
from sdps.refinement.shape.priors import find_neighbours, measure_curl
from sdps.refinement.sites import Grid
from sdps.refinement.surroundings import light_fit
from sdps.refinement.surroundings.hidden import find_hidden
from sdps.refinement.surroundings.light_fit import Fit, Pixels
from sdps.refinement.trust import are_even

MOST = 32
"""Of more images, so many are taken, evenly."""
TILE_PIXELS = 200_000
"""Pixels of a tile and its halo: 0.4 GiB under `MOST` images."""
_HALO = 16
_USUAL_IMAGES, _USUAL_MISFIT, _USUAL_ERROR = 16, 4e-3, 10.0
"""With fewer images, or a larger misfit, photographs count less against the start; with larger errors, more."""
_LEAST_MISFIT = 2e-4
"""Models that fit even better are not believed more."""
_ERRORS = 3.0, 40.0
"""Least and largest error of the start, in degrees, that is believed."""
_GAIN, _FADES = 0.3, 6e-3
"""Share of the error that is gone where the model fits perfectly, and the misfit at which that is down to 1 / e; from
`lab.studies.low_order_study`."""
_LEAST_FACING = 0.01
_LEAST_RATE = 0.02


@dataclass(frozen=True, kw_only=True)
class LowOrderConfig:
    """How an object is refined under low-order light.

    Attributes:
        coarse_pixels: About how many pixels the coarse grid has.
        iterations: On the coarse grid.
        fine_iterations: On every pixel.
        rate: Learning rate of Adam; it falls along a cosine.
        near: Weight of how far normals are from a start that is off by 10 degrees, against the misfit over that at the
            start.
        curl: Weight of the curl.
        every: Iterations after which light is fitted again.
        visibility: Whether what the object hides of the light is left out.
    """

    coarse_pixels: int = 2800
    iterations: int = 60
    fine_iterations: int = 30
    rate: float = 0.02
    near: float = 1.5
    curl: float = 3.0
    every: int = 5
    visibility: bool = True

    def __post_init__(self) -> None:
        check_fields(self, "positive", "coarse_pixels", "iterations", "rate", "near", "curl", "every")
        check_fields(self, "not negative", "fine_iterations")


@dataclass(frozen=True, eq=False)
class LowOrderResult:
    """What refinement under low-order light finds.

    Attributes:
        normals: (H, W, 3) float32, unit, zero outside the mask.
        expected: (H, W) float32, angle to the true normals to expect, in degrees, zero outside the mask.
        light: (L, 9, 3) float32, harmonics of each image's light at the object's middle (`sdps.core.lighting`), by
            channel, so that light times albedo is radiance; of images that were left out, zero.
        albedo: (H, W, 3) float32, relative, mean 1 over the mask; zero outside.
        misfit: Robust mean square of the residuals on the coarse grid, at the start and at the end.
        doubt: Why the start is to be kept, in one line; empty where refinement is better.
    """

    normals: np.ndarray
    expected: np.ndarray
    light: np.ndarray
    albedo: np.ndarray
    misfit: tuple[float, float]
    doubt: str


def refine_low_order(
    images: ImageSource, mask: np.ndarray, normals: np.ndarray, expected: np.ndarray | None = None,
    camera: Camera = ORTHOGRAPHIC, *, saturation: float = np.inf, config: LowOrderConfig | None = None,
) -> LowOrderResult:  # fmt: skip
    """Refine normals under light that nothing is known of.

    Args:
        images: (L, H, W, 3) linear radiance, each of any exposure; an array or what reads it a few at a time.
        mask: (H, W) bool.
        normals: (H, W, 3), unit, camera frame (x right, y up, z to the camera), as a method found them.
        expected: (H, W), the error to expect of each in degrees; None: 10.
        camera: What the images were taken with.
        saturation: Radiance at which a channel is clipped; such observations are ignored.
        config: Iterations, rates and weights.

    Raises:
        InputError: fewer than four images, shapes that do not fit, values that are not finite, or an image in which the
            object is black.
    """
    config = config or LowOrderConfig()
    expected = np.full(mask.shape, _USUAL_ERROR, np.float32) if expected is None else expected
    _check(len(images), mask, normals, expected)
    chosen = np.array(spread_evenly(range(len(images)), MOST))
    scene = survey(images, mask, 0)
    start, errors = normals[scene.rows, scene.columns], expected[scene.rows, scene.columns]
    stride = max(1, round(float(np.sqrt(mask.sum() / config.coarse_pixels))))
    camera = camera.crop(mask.shape, scene.rows.start, scene.columns.start)
    grid = Grid(Capture.of(scene.mask, camera), scene.mask, stride)
    levels = np.array([scene.sample[number].mean(dtype=np.float64) for number in chosen], np.float32)
    solver = _Solver(scene, chosen, levels, saturation, grid, config)
    coarse = solver.refine_grid(start[grid.which], errors[grid.which])
    return solver.finish(coarse, start, errors, len(images))


@dataclass(frozen=True, eq=False)
class _Coarse:
    """What the coarse grid found: normals before and after, heights (h, w) in its steps, C, and the fit."""

    start: Tensor
    normals: Tensor
    heights: np.ndarray
    hidden: Tensor
    fit: Fit
    misfit: tuple[float, float]
    gain: float


@dataclass(frozen=True, eq=False)
class _Solver:
    scene: ObjectImages
    chosen: np.ndarray
    levels: np.ndarray
    saturation: float
    grid: Grid
    config: LowOrderConfig

    def refine_grid(self, normals: np.ndarray, errors: np.ndarray) -> _Coarse:
        """Refine the coarse grid, from normals (p, 3) that are off by errors (p,)."""
        grid, config = self.grid, self.config
        start, mask = _unit(normals), grid.mask[:: grid.stride, :: grid.stride]
        heights = grid.integrate(start)
        places = grid.sites(heights).places.numpy()
        hidden = find_hidden(heights, mask, start.numpy(), grid.camera)
        hidden = hidden if config.visibility else torch.zeros_like(hidden)
        pixels = self._gather(self.scene, grid.which, places, hidden)
        first = light_fit.fit(pixels, start)
        before = light_fit.measure_misfit(pixels, first)
        gain = min(1.0, len(self.chosen) / _USUAL_IMAGES) * _USUAL_MISFIT / max(before, _LEAST_MISFIT)
        sights = _sights(grid.camera, mask)
        moved, found = descend(
            pixels, mask, start, start, first, _weigh(errors), gain, sights, config, config.iterations, free=True
        )
        return _Coarse(start, moved, heights, hidden, found, (before, light_fit.measure_misfit(pixels, found)), gain)

    def finish(self, coarse: _Coarse, start: np.ndarray, errors: np.ndarray, count: int) -> LowOrderResult:
        """Refine every pixel, and lay out what was found, of `count` images."""
        scene, mask = self.scene, self.scene.mask
        normals, albedo = np.zeros((2, *mask.shape, 3), np.float32)
        parts = tiles(mask, TILE_PIXELS, _HALO)
        for number, tile in enumerate(parts):
            inside = mask[tile.inner]
            for picture, values in zip((normals, albedo), self._refine_tile(tile, coarse, start, errors), strict=True):
                picture[tile.inner][inside] = values
            stage("refinement", number + 1, len(parts))
            if len(parts) > 1:
                release_memory()
        light = np.zeros((count, 9, 3), np.float32)
        light[self.chosen] = coarse.fit.light[:, :, :9].permute(0, 2, 1).numpy() * self.levels[:, None, None]
        size = max(float(albedo[mask].mean()), 1e-9)
        error = np.where(mask, predict_error(errors, coarse.misfit[0]), 0.0).astype(np.float32)
        return LowOrderResult(
            scene.in_frame(normals), scene.in_frame(error), light * size, scene.in_frame(albedo / size),
            coarse.misfit, find_doubt(start[mask], coarse.misfit),
        )  # fmt: skip

    def _refine_tile(
        self, tile: Tile, coarse: _Coarse, start: np.ndarray, errors: np.ndarray
    ) -> Iterator[np.ndarray]:  # fmt: skip
        """Return normals and albedo of the inner part's pixels, (n, 3) each."""
        grid, config = self.grid, self.config
        outer = tile.outer_rows, tile.outer_columns
        mask, begun = self.scene.mask[outer], _unit(start[outer][self.scene.mask[outer]])
        thin = grid.mask[:: grid.stride, :: grid.stride]
        up = make_interpolator(thin, mask, grid.stride, (outer[0].start, outer[1].start))
        heights = grid.stride * up(coarse.heights[thin][:, None])[:, 0].numpy()
        rows, columns = np.nonzero(mask)
        places = grid.capture.place(rows + outer[0].start, columns + outer[1].start, heights)
        hidden = up(coarse.hidden.flatten(1).numpy()).unflatten(1, (9, 3))
        pixels = self._gather(self.scene.part(*outer), mask, places, hidden)
        moved = normalize(begun + up((coarse.normals - coarse.start).numpy()), dim=1)
        found, basis = light_fit.start_fit(pixels), light_fit.spread(moved, pixels)
        found = light_fit.update(pixels, basis, found, coarse.fit.light)
        sights = _sights(grid.capture.camera.crop(grid.mask.shape, outer[0].start, outer[1].start), mask)
        own = _weigh(errors[outer][mask])
        moved, found = descend(
            pixels, mask, begun, moved, found, own, coarse.gain, sights, config, config.fine_iterations, free=False
        )
        inner = np.zeros(mask.shape, bool)
        inner[tile.within] = self.scene.mask[tile.inner]
        return (values.numpy()[inner[mask]] for values in (moved, found.albedo))

    def _gather(self, part: ObjectImages, which: np.ndarray, places: np.ndarray, hidden: Tensor) -> Pixels:
        """Read the pixels of a mask (h, w) of a part of the images."""
        values = allocate((int(which.sum()), len(self.chosen), 3))
        for place, number in enumerate(self.chosen):
            values[:, place] = part.read(number, number + 1)[0][which]
        full = np.full((len(self.chosen), 3), self.saturation)
        return light_fit.gather(values, full, self.levels, places, hidden)


def descend(
    pixels: Pixels, mask: np.ndarray, start: Tensor, begun: Tensor, found: Fit, pull: Tensor, gain: float,
    sights: Tensor, config: LowOrderConfig, iterations: int, *, free: bool,
) -> tuple[Tensor, Fit]:  # fmt: skip
    """Return normals (P, 3) after some iterations of Adam, and the fit there.

    Args:
        pixels: The true pixels of the mask (H, W).
        mask: Says which are neighbours.
        start: (P, 3), what normals are held to.
        begun: (P, 3), where they begin.
        found: The fit there.
        pull: (P,), weight of the squared distance to the start, within `config.near`.
        gain: Weight of the misfit.
        sights: (P, 3) v', towards the camera, z = 1.
        config, iterations: Rates and weights.
        free: The light is fitted again every few iterations; else it stays.
    """
    near, moving = find_neighbours(mask), begun.clone().requires_grad_()
    adam = torch.optim.Adam([moving], lr=config.rate)
    for number in range(iterations):
        part = (1.0 + cos(pi * number / iterations)) / 2.0
        adam.param_groups[0]["lr"] = config.rate * max(part, _LEAST_RATE)
        adam.zero_grad(set_to_none=True)
        normals = normalize(moving, dim=1)
        basis = light_fit.spread(normals, pixels)
        with torch.no_grad():
            refit = free and number % config.every == 0
            light = light_fit.fit_light(pixels, basis, found) if refit else found.light
            found = light_fit.update(pixels, basis, found, light)
            towards = light_fit.slope(pixels, found)
        loss = gain * (basis * towards).sum()
        loss = loss + config.near * (pull * (normals - start).square().sum(dim=1)).mean()
        loss = loss + config.curl * measure_curl(normals, near, sights)
        loss.backward()
        adam.step()
        with torch.no_grad():
            facing = (moving * sights).sum(dim=1, keepdim=True)
            moving += (_LEAST_FACING - facing).clamp_min(0.0) * sights
            moving /= moving.norm(dim=1, keepdim=True)
    normals = moving.detach()
    return normals, light_fit.update(pixels, light_fit.spread(normals, pixels), found, found.light)


def predict_error(errors: np.ndarray, misfit: float) -> np.ndarray:
    """Return the error to expect after refinement, of that before it and the misfit at the start."""
    return errors * (1.0 - _GAIN * float(np.exp(-misfit / _FADES)))


def find_doubt(normals: np.ndarray, misfit: tuple[float, float]) -> str:
    """Return why the start, normals (P, 3), is to be kept, or nothing."""
    if are_even(normals):
        return "the object is flat, so photographs cannot show its tilt apart from the light"
    if not misfit[1] <= misfit[0]:
        return f"refinement explains the photographs no better: misfit {misfit[1]:.4f}, {misfit[0]:.4f} without it"
    return ""


def _check(count: int, mask: np.ndarray, normals: np.ndarray, expected: np.ndarray) -> None:
    check_start(count, mask, normals)
    if expected.shape != mask.shape:
        raise InputError(
            f"refinement: mask {mask.shape} and expected errors {expected.shape} do not fit; give one per pixel"
        )
    if not (np.isfinite(normals[mask]).all() and np.isfinite(expected[mask]).all()):
        raise InputError("refinement: normals or expected errors contain NaN or infinity inside the mask")


def _unit(normals: np.ndarray) -> Tensor:
    return normalize(torch.from_numpy(np.array(normals, np.float32)), dim=1)


def _weigh(errors: np.ndarray) -> Tensor:
    """Return the weight of the start at pixels that are off by errors (P,), in degrees."""
    return torch.from_numpy((_USUAL_ERROR / np.clip(errors, *_ERRORS)).astype(np.float32) ** 2)


def _sights(camera: Camera, mask: np.ndarray) -> Tensor:  # (P, 3)
    rows, columns = np.nonzero(mask)
    return torch.from_numpy(camera.look(mask.shape, rows, columns).astype(np.float32))
