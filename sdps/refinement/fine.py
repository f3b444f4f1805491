"""From the coarse grid to every pixel, and from tiles to the result.

Large objects are refined in tiles with a halo, so that memory does not grow with their size. Lights and reflectance are
fixed here, and a pixel depends on its neighbours alone, so tiles join; but how strongly normals are pulled to the start
depends on how well the model fits, which is then measured tile by tile.
"""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from sdps.inference.image_source import ObjectImages
from sdps.inference.tiles import Tile
from sdps.refinement.descent import Problem
from sdps.refinement.image_model import Refined, State, build_model, measure_differences
from sdps.refinement.modes import evaluate_modes
from sdps.refinement.problems import build_problem, estimate_log_albedo, split_pixels
from sdps.refinement.sites import Grid, place_sites


def upsample(
    values: np.ndarray, scene: ObjectImages, tile: Tile, coarse: Problem, grid: Grid, heights: np.ndarray | None,
    state: State, full: np.ndarray,
) -> tuple[Problem, State]:  # fmt: skip
    """Return the problem of every pixel and the state there: interpolated between coarse pixels, but for the albedo.

    Args:
        values: (P, 3, L) radiance of the outer part's pixels; divided in place.
        scene: The object.
        tile: Which part of it.
        coarse: The pixels of the coarse grid.
        grid: Where these lie.
        heights: Of these, (h, w) in steps of the grid; None: lamps are distant, the camera is orthographic.
        state: On the coarse grid.
        full: (3, L), radiance at which a channel is clipped.
    """
    model, mask = build_model(state), scene.mask[tile.outer_rows, tile.outer_columns]
    mean = None if mask.shape == scene.mask.shape else coarse.mean  # the same for all tiles
    problem = build_problem(values, mask, 1, model.log_intensities.exp().numpy(), full, mean)
    up = make_interpolator(coarse.mask, mask, grid.stride, (tile.outer_rows.start, tile.outer_columns.start))
    normals = up(state.normals.numpy())
    normals /= normals.norm(dim=1, keepdim=True)
    own = model._replace(normals=normals)
    if heights is not None:
        own_heights = grid.stride * up(heights[coarse.mask][:, None])[:, 0]
        rows, columns = np.nonzero(mask)
        rows, columns = rows + tile.outer_rows.start, columns + tile.outer_columns.start
        problem = problem._replace(sites=place_sites(grid.capture, rows, columns, own_heights.numpy()))
    share = (coarse.images - coarse.remove_bounced(model, float(state.whiteness))) * (coarse.mean / problem.mean)
    for number in range(values.shape[2]):
        if coarse.bounced is not None:
            problem.images[:, :, number].sub_(up(share[:, :, number].numpy())).clamp_min_(0.0)
            lit = up(coarse.usable[:, number : number + 1].numpy())[:, 0] > 0.5
            problem.usable[:, number].mul_(lit)
        lamp = slice(number, number + 1)
        one = own._replace(directions=model.directions[lamp], nearness=model.nearness[lamp])
        problem.images[:, :, number].div_(evaluate_modes(one, state.modes, problem.sites))
    problem = problem._replace(corrected=True)
    state = state._replace(normals=normals, log_strength=up(state.log_strength.numpy()[:, None])[:, 0])
    return problem, state._replace(log_albedo=estimate_log_albedo(problem, state))


def make_interpolator(
    coarse: np.ndarray, mask: np.ndarray, stride: int, start: tuple[int, int]
) -> Callable[[np.ndarray], Tensor]:
    """Return a function that interpolates values (P, C) of the coarse pixels to all pixels of a part at `start`.

    Bilinear; outside the coarse pixels, the nearest of them continue.
    """
    nearest = tuple(ndimage.distance_transform_edt(~coarse, return_distances=False, return_indices=True))
    places = (np.argwhere(mask) + start).T / stride

    def up(values: np.ndarray) -> Tensor:
        grid = np.zeros((*coarse.shape, values.shape[1]), np.float32)
        grid[coarse] = values
        filled = grid[nearest]
        found = [ndimage.map_coordinates(filled[..., k], places, order=1, mode="nearest") for k in range(grid.shape[2])]
        return torch.from_numpy(np.stack(found, axis=-1).astype(np.float32))

    return up


def collect(scene: ObjectImages, parts: Iterable[tuple[Tile, Problem, State]], state: State) -> Refined:
    """Put the tiles together, and measure how far the model is from the images.

    Args:
        scene: The object.
        parts: Tiles with their pixels and the state there.
        state: Holds what is the same in all tiles.
    """
    normals, albedo = np.zeros((2, *scene.shape, 3), np.float32)
    strength, residual, used = np.zeros((3, *scene.shape), np.float32)
    by_image, model = torch.zeros(len(scene)), build_model(state)
    for tile, problem, own in parts:
        found, of_images = _evaluate_tile(tile, problem, own, scene.mask[tile.inner])
        del problem, own  # before the next tile is made
        by_image += of_images
        for picture, values in zip((normals, albedo, strength, residual, used), found, strict=True):
            picture[scene.rows, scene.columns][tile.inner][scene.mask[tile.inner]] = values
    return Refined(
        normals=normals,
        light_directions=model.directions.numpy(),
        intensities=model.log_intensities.exp().numpy(),
        albedo=albedo,
        strength=strength,
        modes=state.modes.numpy(),
        body=model.body.numpy(),
        amplitudes=model.amplitudes.numpy(),
        sharpness=model.sharpness.numpy(),
        nearness=model.nearness.numpy(),
        pixel_residual=residual,
        image_residual=(by_image / int(scene.mask.sum())).numpy(),
        used=used,
    )


def _evaluate_tile(tile: Tile, problem: Problem, state: State, inside: np.ndarray) -> tuple[list[np.ndarray], Tensor]:
    """Return what `collect` puts together of the inner part's pixels, and residuals summed over them (L,)."""
    model, inner = build_model(state), np.zeros(problem.mask.shape, bool)
    inner[tile.within] = inside
    chosen = torch.from_numpy(inner[problem.mask])
    by_pixel, by_image = torch.empty(len(problem.images)), torch.zeros(problem.images.shape[2])
    images = problem.correct(model, state)
    for part in split_pixels(len(by_pixel)):
        sites = None if problem.sites is None else problem.sites.select(part)
        gaps = measure_differences(model.select(part), images[part], problem.usable[part] == 0.0, sites)
        by_pixel[part] = gaps.mean(dim=(1, 2))
        by_image += gaps[chosen[part]].mean(dim=1).sum(dim=0)
    found = (model.normals, model.albedo, model.strength, by_pixel, problem.usable.mean(dim=1))
    return [values[chosen].numpy() for values in found], by_image
