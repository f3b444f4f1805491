"""Moving a state until the model explains the images: a coarse grid first, then every pixel."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from render.shared.errors import InputError
from sdps.refinement.fused import data_term
from sdps.refinement.image_model import Factors, State, factors
from sdps.refinement.priors import Neighbours, anchor, curl, neighbours, roughness

RATES = {
    "normals": 0.01,
    "log_albedo": 0.02,
    "log_strength": 0.05,
    "body": 0.01,
    "lobes": 0.05,
    "log_sharpness": 0.01,
    "directions": 0.003,
    "log_intensities": 0.003,
}
"""Learning rates of Adam, by part of the state, before `boost`."""
_LEAST_RATE = 0.02
_TRIED_EVERY, _TRIED, _WHITEST = 20, 0.05, 0.95
"""Iterations after which other albedos of the brightest parts are tried, by how much they differ, and the largest."""
_FITS, _MISFITS = 0.01, 0.03
"""A data term of a model that fits, and one of a model that does not; start and end of the trust in the start."""


class Weights(NamedTuple):
    """Weights of the priors.

    Attributes:
        smooth: Of the roughness of normals.
        albedo: Of the roughness of the albedos' logarithms. Few and even colours tell how a relief is stretched.
        gloss: Of the roughness of the strengths' logarithms.
        gloss_size: Of their squares, within `gloss`.
        body: Of the length of b: how far the body is from Lambertian.
        curl: Of the curl, at the start and at the end; in between it falls exponentially.
        shift: Of where the lights point on average, likewise. Networks tell that well, and highlights, once found,
            better.
        near: Of how far the normals are from the start, by how badly the model fits: a model that does not describe
            the object's reflectance explains it by wrong normals.
    """

    smooth: float = 0.005
    albedo: float = 0.05
    gloss: float = 0.003
    gloss_size: float = 0.1
    body: float = 0.01
    curl: tuple[float, float] = (0.6, 0.1)
    shift: tuple[float, float] = (10.0, 0.03)
    near: float = 0.15


class Problem(NamedTuple):
    """One grid of pixels.

    Attributes:
        mask: (H, W) bool, P true pixels.
        images: (P, 3, L) float32, divided by their mean.
        kept: (P, L) float32, 0 for observations that count for nothing.
        mean: What the images were divided by.
        bounced: (P, 3, L) float32, light that other parts of the object throw on a pixel, as it would be under lights
            of intensity 1 if the brightest parts reflected everything; None where it is left out.
        twice: How much brighter it would be by what bounces again.
    """

    mask: np.ndarray
    images: Tensor
    kept: Tensor
    mean: float = 1.0
    bounced: Tensor | None = None
    twice: float = 0.0

    def direct(self, made: Factors, whiteness: float) -> Tensor:  # (P, 3, L)
        """Return the images without the light that bounced, if the brightest parts have this albedo."""
        if self.bounced is None:
            return self.images
        share = whiteness + self.twice * whiteness**2
        found = torch.addcmul(self.images, self.bounced, made.log_intensities.detach().exp().T, value=-share)
        return found.clamp_min_(0.0)


def solve(
    problem: Problem,
    state: State,
    *,
    free: frozenset[str],
    iterations: int,
    boost: float,
    weights: Weights,
    after: Callable[[], object] = lambda: None,
) -> State:
    """Return the state after some iterations of Adam on the data term and the priors.

    Args:
        problem: The pixels.
        state: Where to start.
        free: Names of the parts of the state that move.
        iterations: How many.
        boost: What `RATES` are multiplied by; they fall along a cosine.
        weights: Of the priors.
        after: Called after each iteration.

    Raises:
        InputError: the loss is no longer a number.
    """
    beside, moving = neighbours(problem.mask), free & RATES.keys()
    state = State(**{name: part.clone().requires_grad_(name in moving) for name, part in state._asdict().items()})
    adam = torch.optim.Adam([{"params": [getattr(state, name)], "base": RATES[name]} for name in sorted(moving)])
    start, begun = normalize(state.directions.detach(), dim=-1), normalize(state.normals.detach(), dim=-1)
    for number in range(iterations):
        part = number / max(iterations - 1, 1)
        for group in adam.param_groups:
            group["lr"] = group["base"] * boost * max((1.0 + math.cos(math.pi * part)) / 2.0, _LEAST_RATE)
        adam.zero_grad(set_to_none=True)
        made = factors(state)
        if number % _TRIED_EVERY == 0:
            images = _whitened(problem, state, made, "whiteness" in free)
        loss = data_term(made, images, problem.kept)
        misfit = min(max((float(loss.detach()) - _FITS) / (_MISFITS - _FITS), 0.0), 1.0)
        loss = loss + weights.near * misfit * (1.0 - (made.normals * begun).sum(dim=1)).mean()
        loss = loss + _priors(state, made, beside, weights, part)
        if "directions" in free:
            stretch, shift = anchor(state.directions, start)
            loss = loss + stretch + _falling(weights.shift, part) * shift
        loss.backward()
        adam.step()
        _unit_length(state, free)
        if not math.isfinite(float(loss.detach())):
            raise InputError("refinement failed: the images hold values that are no numbers")
        after()
    return State(*(part.detach() for part in state))


@torch.no_grad()
def _whitened(problem: Problem, state: State, made: Factors, free: bool) -> Tensor:
    """Return the images without bounced light; move the albedo of the brightest parts to where they fit better."""
    if problem.bounced is None:
        return problem.images
    now = float(state.whiteness)
    tried = {min(max(now + step, 0.0), _WHITEST) for step in (-_TRIED, 0.0, _TRIED)} if free else {now}
    shown = {white: problem.direct(made, white) for white in sorted(tried)}
    best = min(shown, key=lambda white: float(data_term(made, shown[white], problem.kept)))
    state.whiteness.fill_(best)
    return shown[best]


def _priors(
    state: State, made: Factors, beside: Neighbours, weights: Weights, part: float
) -> Tensor:  # fmt: skip
    loss = weights.smooth * roughness(made.normals, beside)
    loss = loss + _falling(weights.curl, part) * curl(made.normals, beside)
    loss = loss + weights.albedo * roughness(state.log_albedo, beside)
    loss = loss + weights.body * (state.body.pow(2).sum() + 0.01).sqrt()
    gloss = state.log_strength
    return loss + weights.gloss * (roughness(gloss, beside) + weights.gloss_size * (gloss**2).mean())


def _falling(weight: tuple[float, float], part: float) -> float:
    first, last = weight
    return first * (last / first) ** part


@torch.no_grad()
def _unit_length(state: State, free: frozenset[str]) -> None:
    """Keep vectors at length 1, and surfaces and lights on the camera's side."""
    for name in ("normals", "directions"):
        if name in free:
            vectors = getattr(state, name)
            vectors[:, 2].clamp_min_(1e-3)
            vectors /= vectors.norm(dim=1, keepdim=True)
