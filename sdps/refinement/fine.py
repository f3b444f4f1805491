"""Every pixel of an object, once the coarse grid has found its lights and what it is made of.

Large objects are refined in tiles with a halo, so that memory does not grow with their size. Lights and reflectance
stay here, and pixels see their neighbours alone, so tiles join; but how far normals are held to the start depends on
how well the model fits, which is then a tile's own.
"""

from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from sdps.inference.image_source import ObjectImages
from sdps.inference.tiles import Tile
from sdps.refinement.descent import Problem
from sdps.refinement.image_model import State, difference, factors
from sdps.refinement.modes import factor
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
        problem.images[:, :, number].div_(factor(normals, made.directions[number : number + 1], state.modes))
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


class Pictures:
    """What was found, laid out tile by tile, and how far the model is from the images.

    Args:
        scene: The object.
    """

    def __init__(self, scene: ObjectImages) -> None:
        self.scene, self.count = scene, 0
        self.normals, self.albedo = np.zeros((2, *scene.shape, 3), np.float32)
        self.strength, self.residual = np.zeros((2, *scene.shape), np.float32)
        self.by_image = torch.zeros(len(scene))

    def add(self, tile: Tile, problem: Problem, state: State) -> None:
        """Lay out a tile's inner part."""
        made, inside = factors(state), self.scene.mask[tile.inner]
        own = np.zeros(problem.mask.shape, bool)
        own[tile.within] = True
        chosen = torch.from_numpy(own[problem.mask])
        by_pixel, images = torch.empty(len(problem.images)), problem.explained(made, state)
        for part in parts_of(len(by_pixel)):
            some = made._replace(normals=made.normals[part], albedo=made.albedo[part], strength=made.strength[part])
            gaps = difference(some, images[part], problem.kept[part] == 0.0)
            by_pixel[part] = gaps.mean(dim=(1, 2))
            self.by_image += gaps[chosen[part]].mean(dim=1).sum(dim=0)
        found = (made.normals, made.albedo, made.strength, by_pixel)
        for picture, values in zip((self.normals, self.albedo, self.strength, self.residual), found, strict=True):
            picture[self.scene.rows, self.scene.columns][tile.inner][inside] = values[chosen].numpy()
        self.count += int(inside.sum())

    def result(self, state: State) -> Refined:
        """Return everything; `state` for what is the same in all tiles."""
        made = factors(state)
        return Refined(
            normals=self.normals,
            light_directions=made.directions.numpy(),
            intensities=made.log_intensities.exp().numpy(),
            albedo=self.albedo,
            strength=self.strength,
            modes=state.modes.numpy(),
            body=made.body.numpy(),
            amplitudes=made.amplitudes.numpy(),
            sharpness=made.sharpness.numpy(),
            pixel_residual=self.residual,
            image_residual=(self.by_image / self.count).numpy(),
        )
