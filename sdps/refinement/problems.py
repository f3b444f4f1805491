"""The pixels that are refined: read from the images, divided by their mean, without unusable observations."""

import tempfile

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from sdps.inference.image_source import ObjectImages
from sdps.inference.tiles import split
from sdps.refinement.descent import Problem
from sdps.refinement.image_model import State, build_model, find_shadows
from sdps.refinement.sites import select_grid

FEWEST = 4
"""With fewer images nothing is refined."""
_LIT_SHARE = 0.1
_LEAST_ALBEDO = 1e-3
_PART = 4096  # pixels worked on at once where arrays of all images are made
CACHE_BYTES = 2**30
"""Pixels are kept in memory up to this size; above it, in a temporary file."""


def check_start(count: int, mask: np.ndarray, normals: np.ndarray) -> None:
    """Refuse too few images, and normals (H, W, 3) that are not those of a mask (H, W)."""
    if count < FEWEST:
        raise InputError(f"refinement needs at least {FEWEST} images, got {count}")
    if normals.shape != (*mask.shape, 3):
        raise InputError(
            f"refinement: mask {mask.shape} and normals {normals.shape} do not fit; give normals per pixel"
        )


def gather_pixels(scene: ObjectImages, which: np.ndarray) -> np.ndarray:  # (P, 3, L) float32
    """Read the pixels of a mask (h, w), image by image."""
    values = allocate((int(which.sum()), 3, len(scene)))
    for number in range(len(scene)):
        values[:, :, number] = scene.read(number, number + 1)[0][which]
    return values


def build_problem(
    values: np.ndarray, mask: np.ndarray, stride: int, intensities: np.ndarray, full: np.ndarray,
    mean: float | None = None,
) -> Problem:  # fmt: skip
    """Return the grid of every `stride`-th pixel; at stride 1, `values` are divided in place, not copied.

    Args:
        values: (P, 3, L) radiance of all the object's pixels, or of the grid's alone.
        mask: (H, W) bool.
        stride: Of the grid.
        intensities: (L, 3) or (L, 1).
        full: (3, L), radiance at which a channel is clipped.
        mean: What the values are divided by; by default their own mean.

    Raises:
        InputError: all values are 0.
    """
    grid = select_grid(mask, stride)
    if stride > 1 and len(values) != grid.sum():
        values = values[grid[mask]]
    mean = mean or float(np.mean([part.mean(dtype=np.float64) for part in values.transpose(2, 0, 1)]))
    if not mean > 0.0:
        raise InputError("refinement: the object is black in every image")
    gathered = torch.from_numpy(values)
    shares = torch.from_numpy((intensities.mean() / intensities).astype(np.float32)).T  # (3, L)
    usable = torch.from_numpy(allocate((len(values), values.shape[2])))
    for part in split_pixels(len(values)):
        clipped = torch.from_numpy((values[part] >= full).any(axis=1))
        gathered[part] /= mean
        usable[part] = (~find_shadows(gathered[part] * shares) & ~clipped).float()
    return Problem(mask[::stride, ::stride], gathered, usable, mean)


def allocate(shape: tuple[int, ...]) -> np.ndarray:
    """Return an uninitialised float32 array: in memory, or in a temporary file if it is large."""
    if 4 * np.prod(shape, dtype=np.int64) <= CACHE_BYTES:
        return np.empty(shape, np.float32)
    with tempfile.TemporaryFile() as file:  # the file is removed with the array
        return np.memmap(file, np.float32, "w+", shape=shape)


def split_pixels(count: int) -> list[slice]:
    """Return the slices of `count` pixels that are worked on at once."""
    return split(count, _PART)


def estimate_log_albedo(problem: Problem, state: State) -> Tensor:  # (P, 3)
    """Return the median over images of radiance by shading, where there is shading."""
    model = build_model(state)
    found = torch.empty(len(problem.images), 3)
    shares = torch.exp(-model.log_intensities).T  # (3, L)
    for part in split_pixels(len(found)):
        seen = model.see(problem.sites, part)
        shade = seen.cosines.clamp_min(0.0)  # (p, L)
        lit = shade > _LIT_SHARE * shade.mean(dim=1, keepdim=True)
        ratio = seen.even_out(problem.images[part] * shares) / shade.clamp_min(1e-6)[:, None]
        found[part] = ratio.masked_fill(~lit[:, None], torch.nan).nanmedian(dim=2).values
    return found.nan_to_num(_LEAST_ALBEDO).clamp_min(_LEAST_ALBEDO).log()
