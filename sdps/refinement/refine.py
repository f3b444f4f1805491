"""Refine what a method found of an object: its normals and lights, until a simple model explains the photographs.

The equations stand in `sdps.refinement.image_model`, the priors in `priors`.
What was measured: docs/studies/refinement.md.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.progress import progress_bar, stage
from sdps.core.integration import integrate
from sdps.inference.image_source import ImageSource, ObjectImages, survey
from sdps.refinement.descent import Problem, Weights, solve
from sdps.refinement.image_model import LOBES, SHAPES, State, difference, factors, shadowed
from sdps.refinement.modes import MODES, factor
from sdps.refinement.refined import Refined
from sdps.refinement.transport import trace

_FEWEST = 4
_OF_PIXELS = frozenset({"normals", "log_albedo", "log_strength"})
_SHARPEST, _BROADEST = 300.0, 10.0
_START_HEIGHT = -4.0
_LIT_SHARE = 0.1
_LEAST_ALBEDO = 1e-3
_BRIGHTEST, _WHITENESS = 0.95, 0.3  # quantile of the brightest parts, and the albedo they begin with
_PART = 4096  # pixels worked on at once where arrays of all images are made
CACHE_BYTES = 2**30
"""Pixels gathered from the images are kept in memory up to so much, beyond it in a file of the temporary folder."""


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """How an object is refined. How the defaults were chosen: docs/studies/refinement.md.

    Attributes:
        coarse_pixels: Pixels of the coarse grid, about.
        iterations: On the coarse grid, with everything free.
        bounces: How often light is followed from one part of the object to another; 0 leaves that and shadows out.
        iterations_before: On the coarse grid for the surface that shadows and such light are traced on.
        boost: What the coarse grid's learning rates are multiplied by.
        fine_iterations: On every pixel, with the lights as the coarse grid found them.
        fine_boost: The same on every pixel.
        fine_curl: Weight of the curl on every pixel.
    """

    coarse_pixels: int = 2800
    iterations: int = 1000
    bounces: int = 2
    iterations_before: int = 500
    boost: float = 4.0
    fine_iterations: int = 120
    fine_boost: float = 8.0
    fine_curl: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, "positive", "coarse_pixels", "iterations", "boost", "fine_boost", "fine_curl")
        check_fields(self, "not negative", "bounces", "iterations_before", "fine_iterations")


def refine(
    images: ImageSource,
    mask: np.ndarray,
    normals: np.ndarray,
    lights: np.ndarray,
    intensities: np.ndarray,
    *,
    directions_given: bool = False,
    config: RefineConfig | None = None,
    stray: bool = True,
    saturation: float = np.inf,
) -> Refined:
    """Refine normals and lights.

    Args:
        images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time; read twice.
        mask: (H, W) bool.
        normals: (H, W, 3) unit, where a method put them.
        lights: (L, 3) unit directions from the surface to the light.
        intensities: (L,) or (L, 3).
        directions_given: Directions stay. Intensities always move: they also take up what the model misses in an image.
        config: Iterations and rates.
        stray: Take stray light off the images.
        saturation: Radiance from which on a channel is clipped; such observations count for nothing.

    Raises:
        InputError: fewer than four images, shapes that do not fit, or an object that is black.
    """
    config = config or RefineConfig()
    gains = _checked(len(images), mask, normals, lights, intensities)
    scene = survey(images, mask, 0, stray=stray)
    stride = max(1, round(float(np.sqrt(mask.sum() / config.coarse_pixels))))
    values = _gathered(scene)
    problem = problem_of(values, scene.mask, stride, gains, full := saturation - scene.stray.T)
    begun = normals[scene.rows, scene.columns][::stride, ::stride][problem.mask]
    free = frozenset(State._fields) - ({"directions"} if directions_given else set())
    fine, before = config.fine_iterations if stride > 1 else 0, config.iterations_before if config.bounces else 0
    with progress_bar(None, total=before + config.iterations + fine, desc="refine", unit="iteration") as bar:
        move = partial(solve, free=free, boost=config.boost, weights=Weights(), after=_advance(bar))
        start = start_of(problem, begun, lights, gains)
        if before:
            problem = _traced(problem, move(problem, start, iterations=before), config.bounces)
            start = start._replace(log_albedo=_log_albedo(problem, start))
        state = move(problem, start, iterations=config.iterations)
        if stride > 1:
            problem, state = _finer(values, scene.mask, problem, stride, state, full)
        if fine:
            weights = Weights(curl=(config.fine_curl, config.fine_curl))
            state = move(problem, state, free=_OF_PIXELS, iterations=fine, boost=config.fine_boost, weights=weights)
    return _result(scene, problem, state)


def _advance(bar: Any) -> Callable[[], None]:
    """Return what moves the bar on by an iteration, and says so."""

    def after() -> None:
        bar.update()
        stage("refinement", bar.n, bar.total)

    return after


def _checked(
    count: int, mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray
) -> np.ndarray:
    """Return the intensities (L, 3), if all sizes fit."""
    if count < _FEWEST:
        raise InputError(f"refinement needs at least {_FEWEST} images, got {count}")
    if normals.shape != (*mask.shape, 3):
        raise InputError(
            f"refinement: mask {mask.shape} and normals {normals.shape} do not fit; give normals per pixel"
        )
    if lights.shape != (count, 3) or len(intensities) != count:
        raise InputError(f"refinement: {count} images, but {len(lights)} lights and {len(intensities)} intensities")
    return np.broadcast_to(np.reshape(intensities, (count, -1)), (count, 3))


def _gathered(scene: ObjectImages) -> np.ndarray:  # (P, 3, L) float32
    """Read the object's pixels, image by image."""
    values = _room((int(scene.mask.sum()), 3, len(scene)))
    for number in range(len(scene)):
        values[:, :, number] = scene.read(number, number + 1)[0][scene.mask]
    return values


def problem_of(values: np.ndarray, mask: np.ndarray, stride: int, intensities: np.ndarray, full: np.ndarray) -> Problem:
    """Return the grid of every `stride`-th pixel; at 1 the pixels `values` are divided in place, not copied.

    Args:
        values: (P, 3, L) radiance of the object's pixels.
        mask: (H, W) bool.
        stride: Of the grid.
        intensities: (L, 3) or (L, 1).
        full: (3, L), from where on a channel is clipped.

    Raises:
        InputError: they are black.
    """
    grid = np.zeros_like(mask)
    grid[::stride, ::stride] = mask[::stride, ::stride]
    if stride > 1:
        values = values[grid[mask]]
    mean = float(np.mean([part.mean(dtype=np.float64) for part in values.transpose(2, 0, 1)]))
    if not mean > 0.0:
        raise InputError("refinement: the object is black in every image")
    gathered = torch.from_numpy(values)
    shares = torch.from_numpy((intensities.mean() / intensities).astype(np.float32)).T  # (3, L)
    kept = torch.from_numpy(_room((len(values), values.shape[2])))
    for part in _parts(len(values)):
        clipped = torch.from_numpy((values[part] >= full).any(axis=1))
        gathered[part] /= mean
        kept[part] = (~shadowed(gathered[part] * shares) & ~clipped).float()
    return Problem(mask[::stride, ::stride], gathered, kept, mean)


def _room(shape: tuple[int, ...]) -> np.ndarray:
    """Return room for float32 values: in memory, or in a file if they are many."""
    if 4 * np.prod(shape, dtype=np.int64) <= CACHE_BYTES:
        return np.empty(shape, np.float32)
    with tempfile.TemporaryFile() as file:  # its place on the disk goes with the array
        return np.memmap(file, np.float32, "w+", shape=shape)


def _parts(count: int) -> list[slice]:
    return [slice(start, min(start + _PART, count)) for start in range(0, count, _PART)]


def start_of(problem: Problem, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray) -> State:
    """Return the state that a method's normals and lights begin with."""
    count = len(problem.images)
    state = State(
        normals=torch.from_numpy(np.array(normals, np.float32)),
        log_albedo=torch.zeros(count, 3),
        log_strength=torch.zeros(count),
        body=torch.zeros(SHAPES),
        lobes=torch.full((LOBES,), _START_HEIGHT),
        log_sharpness=torch.linspace(np.log(_SHARPEST), np.log(_BROADEST), LOBES),
        directions=torch.from_numpy(np.array(lights, np.float32)),
        log_intensities=torch.from_numpy(np.log(np.maximum(intensities, 1e-6)).astype(np.float32)),
        whiteness=torch.tensor(_WHITENESS),
        modes=torch.zeros(MODES),
    )
    state.normals[:, 2].clamp_min_(1e-3)
    return state._replace(log_albedo=_log_albedo(problem, state))


def _log_albedo(problem: Problem, state: State) -> Tensor:  # (P, 3)
    """Return the median over images of radiance by shading, where there is shading."""
    made = factors(state)
    found = torch.empty(len(problem.images), 3)
    shares = torch.exp(-made.log_intensities).T  # (3, L)
    for part in _parts(len(found)):
        shade = (made.normals[part] @ made.directions.T).clamp_min(0.0)  # (p, L)
        lit = shade > _LIT_SHARE * shade.mean(dim=1, keepdim=True)
        ratio = problem.images[part] * shares / shade.clamp_min(1e-6)[:, None]
        found[part] = ratio.masked_fill(~lit[:, None], torch.nan).nanmedian(dim=2).values
    return found.nan_to_num(_LEAST_ALBEDO).clamp_min(_LEAST_ALBEDO).log()


def _traced(problem: Problem, state: State, bounces: int) -> Problem:
    """Return the problem without observations in cast shadows, and with the light between parts of the object."""
    made = factors(state)
    normals, lights, albedo = (part.numpy() for part in (made.normals, made.directions, made.albedo))
    laid = np.zeros((*problem.mask.shape, 3))
    laid[problem.mask] = normals
    heights = integrate(laid, problem.mask, discontinuities=True).z
    found = trace(heights, problem.mask, normals, lights)
    brightest = float(np.quantile(albedo, _BRIGHTEST))
    first, more = (found.bounced(normals, albedo / brightest, lights, count) for count in (1, bounces))
    twice = float(more.sum() / max(first.sum(), 1e-9)) - 1.0
    first *= brightest
    kept = problem.kept * torch.from_numpy(found.lit)
    return problem._replace(kept=kept, bounced=torch.from_numpy(first), twice=twice)


def _finer(
    values: np.ndarray, mask: np.ndarray, coarse: Problem, stride: int, state: State, full: np.ndarray
) -> tuple[Problem, State]:
    """Return every pixel, and the state there: interpolated between the coarse pixels, with an albedo of its own."""
    made = factors(state)
    problem = problem_of(values, mask, 1, made.log_intensities.exp().numpy(), full)
    up = _interpolation(coarse.mask, mask, stride)
    normals = up(state.normals.numpy())
    normals /= normals.norm(dim=1, keepdim=True)
    share = (coarse.images - coarse.direct(made, float(state.whiteness))) * (coarse.mean / problem.mean)
    for number in range(values.shape[2]):
        if coarse.bounced is not None:
            problem.images[:, :, number].sub_(up(share[:, :, number].numpy())).clamp_min_(0.0)
            lit = up(coarse.kept[:, number : number + 1].numpy())[:, 0] > 0.5
            problem.kept[:, number].mul_(lit)
        problem.images[:, :, number].div_(factor(normals, made.directions[number : number + 1], state.modes))
    problem = problem._replace(ready=True)
    state = state._replace(normals=normals, log_strength=up(state.log_strength.numpy()[:, None])[:, 0])
    return problem, state._replace(log_albedo=_log_albedo(problem, state))


def _interpolation(coarse: np.ndarray, mask: np.ndarray, stride: int) -> Callable[[np.ndarray], Tensor]:
    """Return what brings values (P, C) of the coarse pixels to all, bilinear; the nearest ones go on outside."""
    nearest = tuple(ndimage.distance_transform_edt(~coarse, return_distances=False, return_indices=True))
    places = np.argwhere(mask).T / stride

    def up(values: np.ndarray) -> Tensor:
        grid = np.zeros((*coarse.shape, values.shape[1]), np.float32)
        grid[coarse] = values
        filled = grid[nearest]
        found = [ndimage.map_coordinates(filled[..., k], places, order=1, mode="nearest") for k in range(grid.shape[2])]
        return torch.from_numpy(np.stack(found, axis=-1).astype(np.float32))

    return up


def _result(scene: ObjectImages, problem: Problem, state: State) -> Refined:
    """Lay out what was found, and how far the model is from the images."""
    made = factors(state)

    def picture(values: Tensor) -> np.ndarray:
        image = np.zeros((*scene.shape, *values.shape[1:]), np.float32)
        image[scene.rows, scene.columns][problem.mask] = values.numpy()
        return image

    images = problem.explained(made, state)
    by_pixel, by_image = torch.empty(len(problem.images)), torch.zeros(len(scene))
    for part in _parts(len(by_pixel)):
        some = made._replace(normals=made.normals[part], albedo=made.albedo[part], strength=made.strength[part])
        gaps = difference(some, images[part], problem.kept[part] == 0.0)
        by_pixel[part] = gaps.mean(dim=(1, 2))
        by_image += gaps.mean(dim=1).sum(dim=0)
    return Refined(
        normals=picture(made.normals),
        light_directions=made.directions.numpy(),
        intensities=made.log_intensities.exp().numpy(),
        albedo=picture(made.albedo),
        strength=picture(made.strength),
        modes=state.modes.numpy(),
        body=made.body.numpy(),
        amplitudes=made.amplitudes.numpy(),
        sharpness=made.sharpness.numpy(),
        pixel_residual=picture(by_pixel),
        image_residual=(by_image / len(by_pixel)).numpy(),
    )
