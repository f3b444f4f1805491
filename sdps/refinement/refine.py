"""Refine what a method found of an object: its normals and lights, until a simple model explains the photographs.

The equations stand in `sdps.refinement.image_model`, the priors in `priors`.
What was measured: docs/studies/refinement.md.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from render.shared.config import check_fields
from render.shared.errors import InputError
from render.shared.progress import progress_bar, stage
from sdps.core.integration import integrate
from sdps.inference.image_source import ImageSource, ObjectImages, survey
from sdps.inference.tiles import Tile, give_back, tiles
from sdps.refinement.descent import Problem, Weights, solve
from sdps.refinement.fine import finer, pictures
from sdps.refinement.image_model import State, factors
from sdps.refinement.problems import gathered, log_albedo, on_grid, problem_of
from sdps.refinement.reflectance import LOBES, MODES, SHAPES
from sdps.refinement.refined import Refined
from sdps.refinement.transport import trace

_FEWEST = 4
_OF_PIXELS = frozenset({"normals", "log_albedo", "log_strength"})
_SHARPEST, _BROADEST = 300.0, 10.0
_START_HEIGHT = -4.0
_BRIGHTEST, _WHITENESS = 0.95, 0.3  # quantile of the brightest parts, and the albedo they begin with
TILE_BYTES = 3 * 2**29
"""Memory for the pixels that are refined at once; objects whose box fits are one tile."""
_PIXEL_BYTES, _OBSERVATION_BYTES = 1200, 20
_HALO = 16


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
        images: (L, H, W, 3) linear radiance, an array or what reads it a few images at a time.
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
    config, gains = config or RefineConfig(), _checked(len(images), mask, normals, lights, intensities)
    scene = survey(images, mask, 0, stray=stray)
    stride = max(1, round(float(np.sqrt(mask.sum() / config.coarse_pixels))))
    most = TILE_BYTES // (_PIXEL_BYTES + _OBSERVATION_BYTES * len(scene)) if stride > 1 else scene.mask.size
    parts = tiles(scene.mask, most, _HALO)
    values = gathered(scene, scene.mask if len(parts) == 1 else on_grid(scene.mask, stride))
    problem = problem_of(values, scene.mask, stride, gains, full := saturation - scene.stray.T)
    begun = normals[scene.rows, scene.columns][::stride, ::stride][problem.mask]
    free = frozenset(State._fields) - ({"directions"} if directions_given else set())
    fine, before = config.fine_iterations if stride > 1 else 0, config.iterations_before if config.bounces else 0
    with progress_bar(None, total=before + config.iterations + fine * len(parts), desc="refine") as bar:
        move = partial(solve, free=free, boost=config.boost, weights=Weights(), after=_advance(bar))
        start = start_of(problem, begun, lights, gains)
        if before:
            problem = _traced(problem, move(problem, start, iterations=before), config.bounces)
            start = start._replace(log_albedo=log_albedo(problem, start))
        state = move(problem, start, iterations=config.iterations)
        if stride == 1:
            return pictures(scene, [(parts[0], problem, state)], state)
        weights = Weights(curl=(config.fine_curl, config.fine_curl))
        settle = partial(move, free=_OF_PIXELS, iterations=fine, boost=config.fine_boost, weights=weights)
        return pictures(scene, _every_pixel(scene, parts, values, problem, stride, state, full, settle), state)


def _every_pixel(
    scene: ObjectImages, parts: list[Tile], values: np.ndarray, coarse: Problem, stride: int, state: State,
    full: np.ndarray, settle: Callable[[Problem, State], State],
) -> Iterator[tuple[Tile, Problem, State]]:  # fmt: skip
    """Yield every pixel, tile by tile; `values` are all pixels' where one tile holds them."""

    def found(tile: Tile) -> tuple[Tile, Problem, State]:  # keeps nothing of one tile while the next is made
        part = scene.part(tile.outer_rows, tile.outer_columns)
        own = values if len(parts) == 1 else gathered(part, part.mask)
        problem, begun = finer(own, scene, tile, coarse, stride, state, full)
        return tile, problem, settle(problem, begun)

    for tile in parts:
        yield found(tile)
        if len(parts) > 1:
            give_back()


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
    return state._replace(log_albedo=log_albedo(problem, state))


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
