"""Refine the normals and lights that a method found, until a simple model explains the photographs.

The model is in `image_model` and `reflectance`, the priors are in `priors`, measurements in docs/studies/refinement.md.
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
from sdps.core.geometry import UNKNOWN, Capture, Rig, reach
from sdps.core.intensities import per_channel
from sdps.inference.image_source import ImageSource, ObjectImages, survey
from sdps.inference.tiles import Tile, release_memory, tiles
from sdps.refinement.descent import Problem, Weights, measure_fit, solve
from sdps.refinement.fine import collect, upsample
from sdps.refinement.image_model import Model, Refined, State, build_model
from sdps.refinement.problems import build_problem, check_start, estimate_log_albedo, gather_pixels
from sdps.refinement.reflectance import LOBES, MODES, SHAPES
from sdps.refinement.shape.transport import trace
from sdps.refinement.sites import Grid, Sites, keep_in_sight

_OF_PIXELS = frozenset({"normals", "log_albedo", "log_strength"})
_SHARPEST, _BROADEST = 300.0, 10.0
_START_HEIGHT = -4.0
START_NEARNESS = 0.03
"""What nearness that is to be found begins with."""
_CLEARLY = 0.02
"""Share by which near lamps must lower the data term: 0.01 where they are distant, 0.04 or more at seven radii."""
_TOLD, _NO_WORSE = 0.06, -0.05
"""Nearness that a network finds only where lamps are near; then near lamps may even raise the data term so much."""
_BRIGHTEST, _WHITENESS = 0.95, 0.3  # quantile of the brightest parts, and the albedo they start with
TILE_BYTES = 3 * 2**29
"""Memory for the pixels that are refined at once; objects whose box fits are one tile."""
_PIXEL_BYTES, _OBSERVATION_BYTES = 1200, 20
_HALO = 16


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """How an object is refined; docs/studies/refinement.md says how the defaults were chosen.

    Attributes:
        coarse_pixels: About how many pixels the coarse grid has.
        iterations: On the coarse grid, with everything free.
        bounces: How often light is followed between parts of the object; 0 ignores bounced light and cast shadows.
        iterations_before: On the coarse grid, for the surface that shadows and bounced light are traced on.
        boost: Factor of the learning rates on the coarse grid.
        fine_iterations: On every pixel, with the lights that the coarse grid found.
        fine_boost: Factor of the learning rates on every pixel.
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
    images: ImageSource, mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray, *,
    directions_given: bool = False, rig: Rig = UNKNOWN, config: RefineConfig | None = None, stray: bool = True,
    saturation: float = np.inf, nearness: np.ndarray | None = None, rim_known: bool = False,
) -> Refined:  # fmt: skip
    """Refine normals and lights.

    Args:
        images, mask: (L, H, W, 3) linear radiance, an array or what reads it a few at a time; (H, W) bool.
        normals, lights, intensities: As a method found them; (H, W, 3) and (L, 3), unit, and (L,) or (L, 3).
        directions_given: Leave directions as they are. Intensities always move: they also absorb what the model misses.
        rig: The camera, and the lamps' nearness where it is known; otherwise it is found.
        config, stray: Iterations and rates; whether stray light is subtracted.
        saturation: Radiance at which a channel is clipped; such observations are ignored.
        nearness: (L,) of the lamps, as a method found it: what to begin with where it is to be found.
        rim_known: Normals of the start are good at the rim, as those of networks that tell their errors are: hold them.

    Raises:
        InputError: fewer than four images, shapes that do not fit, or an object that is black.
    """
    config, gains = config or RefineConfig(), _check(len(images), mask, normals, lights, intensities)
    scene = survey(images, mask, 0, stray=stray)
    stride = max(1, round(float(np.sqrt(mask.sum() / config.coarse_pixels))))
    most = TILE_BYTES // (_PIXEL_BYTES + _OBSERVATION_BYTES * len(scene)) if stride > 1 else scene.mask.size
    capture = Capture.of(scene.mask, rig.camera.crop(mask.shape, scene.rows.start, scene.columns.start))
    grid, parts = Grid(capture, scene.mask, stride), tiles(scene.mask, most, _HALO)
    values = gather_pixels(scene, scene.mask if len(parts) == 1 else grid.which)
    problem = build_problem(values, scene.mask, stride, gains, full := saturation - scene.stray.T)
    problem = problem._replace(sites=None if rig.is_plain else grid.sites())
    first = max(START_NEARNESS, 0.0 if nearness is None else float(np.mean(nearness)))
    start = build_start(problem, normals[scene.rows, scene.columns][grid.which], lights, gains, rig.nearness, first)
    fine, before = config.fine_iterations if stride > 1 else 0, config.iterations_before if config.bounces else 0
    free, tries = _choose_free(directions_given, rig), 1 if rig.nearness is not None else 2
    with progress_bar(None, total=tries * before + config.iterations + fine * len(parts), desc="refine") as bar:
        weights = Weights() if rim_known else Weights(rim=0.0)
        move = partial(solve, boost=config.boost, weights=weights, on_step=_advance(bar))
        if before:
            problem, found, free = _choose_lamps(problem, start, free, partial(move, iterations=before), rig, first)
            problem, start = _trace_light(problem, start, found, config.bounces, grid)
        state = move(problem, start, free=free, iterations=config.iterations)
        if stride == 1:
            return collect(scene, [(parts[0], problem, state)], state)
        weights = weights._replace(curl=(config.fine_curl, config.fine_curl))
        settle = partial(move, free=_OF_PIXELS, iterations=fine, boost=config.fine_boost, weights=weights)
        return collect(scene, _refine_tiles(scene, parts, values, problem, grid, state, full, settle), state)


def _refine_tiles(
    scene: ObjectImages, parts: list[Tile], values: np.ndarray, coarse: Problem, grid: Grid, state: State,
    full: np.ndarray, settle: Callable[[Problem, State], State],
) -> Iterator[tuple[Tile, Problem, State]]:  # fmt: skip
    """Yield the tiles with their refined pixels; `values` are those of all pixels if there is one tile."""
    heights = None if coarse.sites is None else grid.integrate(build_model(state).normals)

    def refine_tile(tile: Tile) -> tuple[Tile, Problem, State]:  # holds nothing of one tile while the next is made
        part = scene.part(tile.outer_rows, tile.outer_columns)
        own = values if len(parts) == 1 else gather_pixels(part, part.mask)
        problem, start = upsample(own, scene, tile, coarse, grid, heights, state, full)
        return tile, problem, settle(problem, start)

    for tile in parts:
        yield refine_tile(tile)
        if len(parts) > 1:
            release_memory()


def _advance(bar: Any) -> Callable[[], None]:
    """Return a function that advances the bar by one iteration and reports it."""

    def on_step() -> None:
        bar.update()
        stage("refinement", bar.n, bar.total)

    return on_step


def _check(
    count: int, mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray
) -> np.ndarray:
    """Return the intensities (L, 3), if all sizes fit."""
    check_start(count, mask, normals)
    if lights.shape != (count, 3) or len(intensities) != count:
        raise InputError(f"refinement: {count} images, but {len(lights)} lights and {len(intensities)} intensities")
    return per_channel(intensities)


def build_start(
    problem: Problem, normals: np.ndarray, lights: np.ndarray, intensities: np.ndarray,
    nearness: np.ndarray | None = None, first: float = START_NEARNESS,
) -> State:  # fmt: skip
    """Return the state that refinement starts from, given a method's normals and lights; nearness (L,) is known, or is
    `first` at first.
    """
    count, rho = len(problem.images), np.ones(len(lights)) if nearness is None else nearness
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
        log_nearness=torch.tensor(np.log(first) if nearness is None else 0.0, dtype=torch.float32),
        uneven=torch.from_numpy(rho.astype(np.float32)).log(),
    )
    keep_in_sight(state.normals, problem.sites)
    return state._replace(log_albedo=estimate_log_albedo(problem, state))


def _choose_free(directions_given: bool, rig: Rig) -> frozenset[str]:
    """Return which parts of the state move."""
    known = rig.nearness is not None
    fixed = {"directions": directions_given, "log_nearness": known, "uneven": known or not rig.each}
    return frozenset(State._fields) - {name for name, stays in fixed.items() if stays}


def _choose_lamps(
    problem: Problem, start: State, free: frozenset[str], move: Callable[..., State], rig: Rig, told: float
) -> tuple[Problem, State, frozenset[str]]:
    """Return the problem, what the first steps find, and what moves from then on: of near lamps, or of distant ones.

    A model that misses something of the reflectance takes nearness for it (metals run to lamps that touch the object),
    so near lamps must explain the photographs clearly better than distant ones do, or be what a network found (`told`).
    """
    clearly = _NO_WORSE if told >= _TOLD else _CLEARLY
    near = move(problem, start, free=free)
    if "log_nearness" not in free:
        return problem, near, free
    distant = problem._replace(sites=problem.sites if rig.camera.is_perspective else None)
    begun = start._replace(log_nearness=torch.tensor(-torch.inf), uneven=torch.zeros_like(start.uneven))
    fixed = free - {"log_nearness", "uneven"}
    far = move(distant, begun, free=fixed)
    if measure_fit(problem, near) < (1.0 - clearly) * measure_fit(distant, far):
        return problem, near, free
    return distant, far, fixed


def _trace_light(
    problem: Problem, start: State, found: State, bounces: int, grid: Grid
) -> tuple[Problem, State]:  # fmt: skip
    """Return the problem as light over the surface that was found shows it, and where to start once more.

    Observations in cast shadows are left out, bounced light is known, pixels are in their places.
    """
    model = build_model(found)
    heights = grid.integrate(model.normals)
    if problem.sites is not None:
        problem = problem._replace(sites=grid.sites(heights))
    shade, ways = _shade_grid(model, problem.sites)
    normals, albedo = model.normals.numpy(), model.albedo.numpy()
    traced = trace(heights, problem.mask, normals, ways, grid.camera)
    brightest = float(np.quantile(albedo, _BRIGHTEST))
    first, more = (traced.bounce(shade, albedo / brightest, count) for count in (1, bounces))
    twice = float(more.sum() / max(first.sum(), 1e-9)) - 1.0
    first *= brightest
    usable = problem.usable * torch.from_numpy(traced.lit)
    problem = problem._replace(usable=usable, bounced=torch.from_numpy(first), twice=twice)
    start = start._replace(log_nearness=found.log_nearness, uneven=found.uneven)
    return problem, start._replace(log_albedo=estimate_log_albedo(problem, start))


def _shade_grid(model: Model, sites: Sites | None) -> tuple[np.ndarray, np.ndarray]:
    """Return n . l falloff (P, L), and the directions of light: (L, 3), or (P, L, 3) where each pixel has its own."""
    normals, lights = model.normals.numpy(), model.directions.numpy()
    if sites is None:
        return normals @ lights.T, lights
    ways, falloff = reach(sites.places.numpy(), lights, model.nearness.numpy())
    return (ways @ normals[..., None])[..., 0] * falloff, ways
