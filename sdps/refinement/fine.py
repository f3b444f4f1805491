"""Every pixel of an object, once the coarse grid has found its lights and what it is made of.

Large objects are refined in tiles with a halo, so that memory does not grow with their size. Lights and reflectance
stay here, and pixels see their neighbours alone, so tiles join; but how far normals are held to the start depends on
how well the model fits, which is then a tile's own.
"""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from sdps.inference.image_source import ObjectImages
from sdps.inference.tiles import Tile
from sdps.refinement.descent import Problem
from sdps.refinement.image_model import State, difference, factors
from sdps.refinement.modes import evaluate_modes
from sdps.refinement.problems import log_albedo, parts_of, problem_of
from sdps.refinement.refined import Refined


def finer(
    values: np.ndarray, scene: ObjectImages, tile: Tile, coarse: Problem, stride: int, state: State, full: np.ndarray
) -> tuple[Problem, State]:
    """Return every pixel, and the state there: interpolated between the coarse pixels, with an albedo of its own.

    Args:
        values: (P, 3, L) radiance of the outer part's pixels; divided in place.
        scene: The object.
        tile: Which part of it.
        coarse: The coarse grid, of every `stride`-th pixel.
        state: On the coarse grid.
        full: (3, L), from where on a channel is clipped.
    """
    made, mask = factors(state), scene.mask[tile.outer_rows, tile.outer_columns]
    mean = None if mask.shape == scene.mask.shape else coarse.mean  # of tiles the same for all
    problem = problem_of(values, mask, 1, made.log_intensities.exp().numpy(), full, mean)
    up = _interpolation(coarse.mask, mask, stride, (tile.outer_rows.start, tile.outer_columns.start))
    normals = up(state.normals.numpy())
    normals /= normals.norm(dim=1, keepdim=True)
    share = (coarse.images - coarse.direct(made, float(state.whiteness))) * (coarse.mean / problem.mean)
    for number in range(values.shape[2]):
        if coarse.bounced is not None:
            problem.images[:, :, number].sub_(up(share[:, :, number].numpy())).clamp_min_(0.0)
            lit = up(coarse.kept[:, number : number + 1].numpy())[:, 0] > 0.5
            problem.kept[:, number].mul_(lit)
        problem.images[:, :, number].div_(evaluate_modes(normals, made.directions[number : number + 1], state.modes))
    problem = problem._replace(ready=True)
    state = state._replace(normals=normals, log_strength=up(state.log_strength.numpy()[:, None])[:, 0])
    return problem, state._replace(log_albedo=log_albedo(problem, state))


def _interpolation(
    coarse: np.ndarray, mask: np.ndarray, stride: int, start: tuple[int, int]
) -> Callable[[np.ndarray], Tensor]:
    """Return what brings values (P, C) of the coarse pixels to all of a part that begins at `start`.

    Bilinear; the nearest coarse pixels go on outside.
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


def pictures(scene: ObjectImages, parts: Iterable[tuple[Tile, Problem, State]], state: State) -> Refined:
    """Lay out what was found, tile by tile, and how far the model is from the images.

    Args:
        scene: The object.
        parts: Tiles with their pixels and the state there.
        state: For what is the same in all tiles.
    """
    normals, albedo = np.zeros((2, *scene.shape, 3), np.float32)
    strength, residual = np.zeros((2, *scene.shape), np.float32)
    by_image, made = torch.zeros(len(scene)), factors(state)
    for tile, problem, own in parts:
        found, of_images = _inner(tile, problem, own, scene.mask[tile.inner])
        del problem, own  # before the next tile is made
        by_image += of_images
        for picture, values in zip((normals, albedo, strength, residual), found, strict=True):
            picture[scene.rows, scene.columns][tile.inner][scene.mask[tile.inner]] = values
    return Refined(
        normals=normals,
        light_directions=made.directions.numpy(),
        intensities=made.log_intensities.exp().numpy(),
        albedo=albedo,
        strength=strength,
        modes=state.modes.numpy(),
        body=made.body.numpy(),
        amplitudes=made.amplitudes.numpy(),
        sharpness=made.sharpness.numpy(),
        pixel_residual=residual,
        image_residual=(by_image / int(scene.mask.sum())).numpy(),
    )


def _inner(tile: Tile, problem: Problem, state: State, inside: np.ndarray) -> tuple[list[np.ndarray], Tensor]:
    """Return normals, albedo, strength and residual of the inner part's pixels, and residuals summed over them (L,)."""
    made, inner = factors(state), np.zeros(problem.mask.shape, bool)
    inner[tile.within] = inside
    chosen = torch.from_numpy(inner[problem.mask])
    by_pixel, by_image = torch.empty(len(problem.images)), torch.zeros(problem.images.shape[2])
    images = problem.explained(made, state)
    for part in parts_of(len(by_pixel)):
        some = made._replace(normals=made.normals[part], albedo=made.albedo[part], strength=made.strength[part])
        gaps = difference(some, images[part], problem.kept[part] == 0.0)
        by_pixel[part] = gaps.mean(dim=(1, 2))
        by_image += gaps[chosen[part]].mean(dim=1).sum(dim=0)
    found = (made.normals, made.albedo, made.strength, by_pixel)
    return [values[chosen].numpy() for values in found], by_image
