"""The optimisation: gradient descent on a state until the model explains the images."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from sdps.refinement.fused import data_term
from sdps.refinement.image_model import DATA_FLOOR, Model, State, build_model
from sdps.refinement.modes import evaluate_modes, fit_modes
from sdps.refinement.reflectance import evaluate_factor, measure_angles
from sdps.refinement.shape.priors import Neighbours, find_neighbours, measure_curl, measure_drift, measure_roughness
from sdps.refinement.sites import Sites, keep_in_sight

RATES = {
    "normals": 0.01,
    "log_albedo": 0.02,
    "log_strength": 0.05,
    "body": 0.01,
    "lobes": 0.05,
    "log_sharpness": 0.01,
    "directions": 0.003,
    "log_intensities": 0.003,
    "log_nearness": 0.01,
    "uneven": 0.01,
}
"""Learning rates of Adam, by part of the state, before `boost`."""
_LEAST_RATE = 0.02
_SEARCH_EVERY, _WHITENESS_STEP, _WHITEST = 20, 0.05, 0.95
"""The albedo of the brightest parts is searched every so many iterations, in such steps, up to such a value."""
_RIM = 0.5  # n_z of the start from which on pixels are not near the rim
_PART = 4096  # pixels worked on at once
_NEARNESS = math.log(1e-3), math.log(0.6)
_FITS, _MISFITS = 0.01, 0.03
"""Data terms of a model that fits and of one that does not: between them, the pull towards the start grows."""


class Weights(NamedTuple):
    """Weights of the priors.

    Attributes:
        smooth: Of the roughness of normals.
        albedo: Of the roughness of the albedos' logarithms. Few and even colours show how a relief is stretched.
        gloss: Of the roughness of the strengths' logarithms.
        gloss_size: Of their squares, within `gloss`.
        body: Of the length of b: how far the body is from Lambertian.
        curl: Of the curl, at the start and at the end; in between it falls exponentially.
        shift: Of where the lights point on average, likewise. Networks know that well, and highlights, once found,
            better.
        near: Of how far the normals are from the start, by how badly the model fits: a model that does not describe
            the object's reflectance would explain it by wrong normals.
        dark: The same for pixels that are dark in all images, which say little, however well the model fits.
        rim: The same for pixels near the rim of the object as the start sees it. Networks see the outline, and know how
            steep the surface is there; the model, where it lacks something of the reflectance, flattens the rim.
        uneven: Of how differently far the lamps stand, where each has a distance of its own: mean square of logarithms.
    """

    smooth: float = 0.005
    albedo: float = 0.05
    gloss: float = 0.003
    gloss_size: float = 0.1
    body: float = 0.01
    curl: tuple[float, float] = (0.6, 0.1)
    shift: tuple[float, float] = (10.0, 0.03)
    near: float = 0.15
    dark: float = 0.1
    rim: float = 3.0
    uneven: float = 0.03


class Problem(NamedTuple):
    """One grid of pixels.

    Attributes:
        mask: (H, W) bool, P true pixels.
        images: (P, 3, L) float32, divided by their mean.
        usable: (P, L) float32, 0 for observations that are ignored, else 1.
        mean: What the images were divided by.
        bounced: (P, 3, L) float32, light that other parts of the object reflect onto a pixel, as it would be under
            lights of intensity 1 if the brightest parts reflected everything; None where it is left out.
        twice: How much brighter further bounces would make it.
        corrected: The images are without bounced light, and divided by G.
        sites: Where the pixels lie; None: lamps are distant, the camera is orthographic.
    """

    mask: np.ndarray
    images: Tensor
    usable: Tensor
    mean: float = 1.0
    bounced: Tensor | None = None
    twice: float = 0.0
    corrected: bool = False
    sites: Sites | None = None

    def remove_bounced(self, model: Model, whiteness: float) -> Tensor:  # (P, 3, L)
        """Return the images without bounced light, if the brightest parts have this albedo."""
        if self.bounced is None:
            return self.images
        share = whiteness + self.twice * whiteness**2
        found = torch.addcmul(self.images, self.bounced, model.log_intensities.detach().exp().T, value=-share)
        return found.clamp_min_(0.0)

    def correct(self, model: Model, state: State) -> Tensor:  # (P, 3, L)
        """Return the images as `data_term` takes them: without bounced light, over G."""
        if self.corrected:
            return self.images
        bent = evaluate_modes(model, state.modes, self.sites)
        return self.remove_bounced(model, float(state.whiteness)) / bent[:, None]


def solve(
    problem: Problem,
    state: State,
    *,
    free: frozenset[str],
    iterations: int,
    boost: float,
    weights: Weights,
    on_step: Callable[[], object] = lambda: None,
) -> State:
    """Return the state after some iterations of Adam on the data term and the priors.

    Args:
        problem: The pixels.
        state: Where to start.
        free: Names of the parts of the state that move.
        iterations: How many.
        boost: What `RATES` are multiplied by; they fall along a cosine.
        weights: Of the priors.
        on_step: Called after each iteration.

    Raises:
        InputError: the loss is no longer a number.
    """
    near, moving = find_neighbours(problem.mask), free & RATES.keys()
    state = State(**{name: part.clone().requires_grad_(name in moving) for name, part in state._asdict().items()})
    adam = torch.optim.Adam([{"params": [getattr(state, name)], "base": RATES[name]} for name in sorted(moving)])
    start = build_model(State(*(part.detach() for part in state)))
    rim = _find_rim(start.see(problem.sites).normals)
    held = weights.dark * _measure_faintness(problem.images) + weights.rim * rim  # (P,)
    for number in range(iterations):
        part = number / max(iterations - 1, 1)
        for group in adam.param_groups:
            group["lr"] = group["base"] * boost * max((1.0 + math.cos(math.pi * part)) / 2.0, _LEAST_RATE)
        adam.zero_grad(set_to_none=True)
        model = build_model(state)
        if number % _SEARCH_EVERY == 0:
            images = _search_globals(problem, state, model, free)
        loss = data_term(model, images, problem.usable, problem.sites)
        pull = weights.near * _measure_misfit(float(loss.detach())) + held
        loss = loss + (pull * (1.0 - (model.normals * start.normals).sum(dim=1))).mean()
        loss = loss + _sum_priors(state, model, near, weights, part, problem.sites)
        loss = loss + _hold_lamps(state, start.directions, free, weights, part)
        loss.backward()
        adam.step()
        _project(state, free, problem.sites)
        if not math.isfinite(float(loss.detach())):
            raise InputError("refinement: the images contain NaN or infinity; leave those out")
        on_step()
    return State(*(part.detach() for part in state))


@torch.no_grad()
def measure_fit(problem: Problem, state: State) -> float:
    """Return the data term of a state."""
    model = build_model(state)
    return float(data_term(model, problem.correct(model, state).contiguous(), problem.usable, problem.sites))


@torch.no_grad()
def _search_globals(problem: Problem, state: State, model: Model, free: frozenset[str]) -> Tensor:
    """Set the brightest parts' albedo and the modes to what fits the images better; return the corrected images."""
    if problem.corrected:
        return problem.images
    seen = model.see(problem.sites)
    angles = measure_angles(seen.normals, seen.directions)
    bent = evaluate_factor(angles, state.modes)[:, None]
    if problem.bounced is not None and "whiteness" in free:
        now = float(state.whiteness)
        tried = sorted({min(max(now + step, 0.0), _WHITEST) for step in (-_WHITENESS_STEP, 0.0, _WHITENESS_STEP)})
        images = (problem.remove_bounced(model, white) / bent for white in tried)
        terms = [float(data_term(model, some, problem.usable, problem.sites)) for some in images]
        state.whiteness.fill_(tried[int(np.argmin(terms))])
    bare = problem.remove_bounced(model, float(state.whiteness))
    if "modes" in free:
        state.modes.copy_(fit_modes(model, bare, problem.usable, seen, angles))
        bent = evaluate_factor(angles, state.modes)[:, None]
    return bare / bent


def _measure_misfit(data: float) -> float:
    """Return how badly a model with this data term fits, from 0 (well) to 1."""
    return min(max((data - _FITS) / (_MISFITS - _FITS), 0.0), 1.0)


def _measure_faintness(images: Tensor) -> Tensor:  # (P,)
    """Return 1 for pixels that are dark in all images, which say little, to 0 for bright ones."""
    bright = torch.empty(len(images))
    for part in range(0, len(images), _PART):
        squared = images[part : part + _PART] ** 2
        bright[part : part + _PART] = (squared / (squared + DATA_FLOOR)).mean(dim=(1, 2))
    return 1.0 - bright


def _find_rim(normals: Tensor) -> Tensor:  # (P,)
    """Return 1 where normals (P, 3), as pixels see them, are square to the view, to 0 from 60 degrees off it on."""
    return (1.0 - normals[:, 2] / _RIM).clamp_min(0.0)


def _sum_priors(
    state: State, model: Model, near: Neighbours, weights: Weights, part: float, sites: Sites | None
) -> Tensor:  # fmt: skip
    loss = weights.smooth * measure_roughness(model.normals, near)
    sights = None if sites is None else sites.sights
    loss = loss + _interpolate(weights.curl, part) * measure_curl(model.normals, near, sights)
    loss = loss + weights.albedo * measure_roughness(state.log_albedo, near)
    loss = loss + weights.body * (state.body.pow(2).sum() + 0.01).sqrt()
    gloss = state.log_strength
    return loss + weights.gloss * (measure_roughness(gloss, near) + weights.gloss_size * (gloss**2).mean())


def _hold_lamps(state: State, start: Tensor, free: frozenset[str], weights: Weights, part: float) -> Tensor:
    """Return the priors of what moves of the lamps; `start` holds their first directions."""
    loss = start.new_zeros(())
    if "directions" in free:
        stretch, shift = measure_drift(state.directions, start)
        loss = loss + stretch + _interpolate(weights.shift, part) * shift
    if "uneven" in free:
        loss = loss + weights.uneven * state.uneven.square().mean()
    return loss


def _interpolate(weight: tuple[float, float], part: float) -> float:
    first, last = weight
    return first * (last / first) ** part


@torch.no_grad()
def _project(state: State, free: frozenset[str], sites: Sites | None) -> None:
    """Keep vectors at length 1, with normals and lights on the camera's side, and lamps out of the object."""
    if "log_nearness" in free:
        state.log_nearness.clamp_(*_NEARNESS)
    for name, own in (("normals", sites), ("directions", None)):
        if name in free:
            vectors = getattr(state, name)
            keep_in_sight(vectors, own)
            vectors /= vectors.norm(dim=1, keepdim=True)
