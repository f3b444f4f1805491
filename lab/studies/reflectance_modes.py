"""Measure how reflectance of real materials leaves the model of refinement: assets/reflectance_modes.yaml.

    python -m lab.studies.reflectance_modes
    python -m lab.studies.reflectance_modes --left pink-felt black-obsidian     # what the whole model does not explain

Spheres of the fitted MERL materials that networks are trained on (the held-out ones are left out), under 100 lights;
normals and lights are known. The reflectance of refinement without its modes is fitted to each sphere. What is left,
as logarithms, is explained by least squares with `mode_terms` of `sdps.refinement.reflectance`. Written: the mean
product of their coefficients over the materials, without the tenth of materials with the largest ones.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import yaml
from torch import Tensor
from tqdm import tqdm

from render.materials.fit.spheres import hemisphere_lights, shading_frame, sphere_normals
from render.materials.library import held_out, load, names
from render.materials.model import Material, evaluate
from render.shared.files import atomic_path
from sdps.refinement.descent import Problem, Weights, solve
from sdps.refinement.image_model import State, build_model
from sdps.refinement.modes import ASSET, LEAST_RADIANCE, compare_logs
from sdps.refinement.problems import build_problem
from sdps.refinement.refine import build_start
from sdps.refinement.reflectance import MODES, measure_angles, mode_terms, shade

_SIDE, _LIGHTS, _ITERATIONS = 42, 100, 300
_GRAZING = 0.2
_KEPT = 0.9  # share of the materials


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, and write the asset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ASSET)
    parser.add_argument("--left", nargs="+", metavar="NAME", help="only say what is left of these materials")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    lights = hemisphere_lights(_LIGHTS, np.random.default_rng(0)).astype(np.float32)
    if args.left:
        for name in tqdm(args.left, disable=None):
            grey, grazing, colour = measure_left(load(name), lights)
            sys.stdout.write(
                f"{name}: {grey:.3f}; {grazing:+.3f} where n.l < {_GRAZING}; channels {colour:.3f} apart\n"
            )
        return 0
    chosen = sorted(set(names()) - set(held_out()))
    found = np.stack([coefficients(load(name), lights) for name in tqdm(chosen, disable=None)])
    size = np.square(found).sum(axis=1)
    found = found[size <= np.quantile(size, _KEPT)]
    rows = [[float(f"{value:.3g}") for value in row] for row in found.T @ found / len(found)]
    with atomic_path(args.out) as temporary:
        head = "# Mean products of the coefficients of reflectance modes. Made by lab/studies/reflectance_modes.py.\n"
        temporary.write_text(head + yaml.safe_dump({"second_moments": rows}, default_flow_style=None, width=110))
    return 0


class Left(NamedTuple):
    """How far the logarithms of radiance and of the model differ: root mean squares, but for `grazing`."""

    grey: float  # of the channels' mean
    grazing: float  # mean of that where n . l is small
    colour: float  # between the channels


def fit(material: Material, lights: np.ndarray, *more: str) -> tuple[Problem, State]:
    """Return the images of a material's sphere, and the state fitted to them; `more`: what is free besides."""
    mask, normals = sphere_normals(_SIDE)
    images = np.zeros((len(normals), 3, len(lights)), np.float32)
    for number, light in enumerate(lights):
        wi, wo = shading_frame(normals, light)
        images[:, :, number] = np.pi * evaluate(material, wi, wo) * np.maximum(wi[:, 2:], 0.0)
    problem: Problem = build_problem(images, mask, 1, np.ones((len(lights), 3)), np.full((3, len(lights)), np.inf))
    state: State = build_start(problem, normals, lights, np.ones((len(lights), 3)))
    free = frozenset({"log_albedo", "log_strength", "body", "lobes", "log_sharpness", *more})
    return problem, solve(problem, state, free=free, iterations=_ITERATIONS, boost=4.0, weights=Weights())


def measure_left(material: Material, lights: np.ndarray) -> Left:
    """Return what the whole model does not explain of a material's sphere."""
    problem, state = fit(material, lights, "modes")
    model = build_model(state)
    seen = model.see(None)
    predicted = shade(seen.normals, seen.directions, SimpleNamespace(**model._asdict(), modes=state.modes))
    left = torch.log((problem.images + LEAST_RADIANCE) / (predicted + LEAST_RADIANCE))  # (P, 3, L)
    grey, usable = left.mean(dim=1), (problem.usable > 0.0) & (predicted.mean(dim=1) > LEAST_RADIANCE)
    weights = seen.cosines.clamp_min(0.0) * usable

    def average(values: Tensor, shares: Tensor) -> float:
        return float((values * shares).sum() / shares.sum())

    return Left(
        grey=average(grey.square(), weights) ** 0.5,
        grazing=average(grey, weights * (seen.cosines < _GRAZING)),
        colour=average((left - grey[:, None]).square().mean(dim=1), weights) ** 0.5,
    )


def coefficients(material: Material, lights: np.ndarray) -> np.ndarray:  # (MODES,)
    """Return the coefficients of a material's modes."""
    problem, state = fit(material, lights)
    model = build_model(state)
    seen = model.see(None)
    angles = measure_angles(seen.normals, seen.directions)
    left, weights = compare_logs(model, problem.images, problem.usable, seen, angles)
    angles = measure_angles(*(torch.from_numpy(part.astype(np.float32)) for part in (sphere_normals(_SIDE)[1], lights)))
    shapes = torch.stack([torch.ones_like(left), *mode_terms(angles)], dim=-1)
    shapes = shapes.flatten(0, 1).double()  # (P L, 1 + MODES)
    root = weights.flatten().double().sqrt()[:, None]
    least = 1e-4 * torch.eye(1 + MODES, dtype=torch.float64) / weights.numel()
    scaled = shapes * root
    return torch.linalg.solve(scaled.T @ scaled + least, scaled.T @ (left.flatten().double()[:, None] * root))[
        1:, 0
    ].numpy()


if __name__ == "__main__":
    sys.exit(main())
