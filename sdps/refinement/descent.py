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
from sdps.refinement.image_model import DATA_FLOOR, Factors, State, factors
from sdps.refinement.modes import evaluate_modes, fitted
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
_PART = 4096  # pixels worked on at once
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
        dark: The same of pixels that are dark in all images, which tell little, however well the model fits.
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
        ready: Bounced light is off the images, and they are divided by G.
    """

    mask: np.ndarray
    images: Tensor
    kept: Tensor
    mean: float = 1.0
    bounced: Tensor | None = None
    twice: float = 0.0
    ready: bool = False

    def direct(self, made: Factors, whiteness: float) -> Tensor:  # (P, 3, L)
        """Return the images without the light that bounced, if the brightest parts have this albedo."""
        if self.bounced is None:
            return self.images
        share = whiteness + self.twice * whiteness**2
        found = torch.addcmul(self.images, self.bounced, made.log_intensities.detach().exp().T, value=-share)
        return found.clamp_min_(0.0)

    def explained(self, made: Factors, state: State) -> Tensor:  # (P, 3, L)
        """Return the images as the term of `fused` takes them: without the light that bounced, over G."""
        if self.ready:
            return self.images
        bent = evaluate_modes(made.normals.detach(), made.directions.detach(), state.modes)
        return self.direct(made, float(state.whiteness)) / bent[:, None]


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
    faint = _faint(problem.images)
    for number in range(iterations):
        part = number / max(iterations - 1, 1)
        for group in adam.param_groups:
            group["lr"] = group["base"] * boost * max((1.0 + math.cos(math.pi * part)) / 2.0, _LEAST_RATE)
        adam.zero_grad(set_to_none=True)
        made = factors(state)
        if number % _TRIED_EVERY == 0:
            images = _explained(problem, state, made, free)
        loss = data_term(made, images, problem.kept)
        held = weights.near * _misfit(float(loss.detach())) + weights.dark * faint  # (P,)
        loss = loss + (held * (1.0 - (made.normals * begun).sum(dim=1))).mean()
        loss = loss + _priors(state, made, beside, weights, part)
        if "directions" in free:
            loss = loss + _lights_prior(state.directions, start, weights, part)
        loss.backward()
        adam.step()
        _unit_length(state, free)
        if not math.isfinite(float(loss.detach())):
            raise InputError("refinement failed: the images hold values that are no numbers")
        after()
    return State(*(part.detach() for part in state))


@torch.no_grad()
def _explained(problem: Problem, state: State, made: Factors, free: frozenset[str]) -> Tensor:
    """Move albedo of the brightest parts and modes to where the images fit better; return `Problem.explained`."""
    if problem.bounced is not None and "whiteness" in free:
        now = float(state.whiteness)
        tried = sorted({min(max(now + step, 0.0), _WHITEST) for step in (-_TRIED, 0.0, _TRIED)})
        states = [state._replace(whiteness=torch.tensor(white)) for white in tried]
        terms = [float(data_term(made, problem.explained(made, one), problem.kept)) for one in states]
        state.whiteness.fill_(tried[int(np.argmin(terms))])
    if "modes" in free:
        state.modes.copy_(fitted(made, problem.direct(made, float(state.whiteness)), problem.kept))
    return problem.explained(made, state)


def _misfit(data: float) -> float:
    """Return how badly a model with this data term fits: from 0, well, to 1."""
    return min(max((data - _FITS) / (_MISFITS - _FITS), 0.0), 1.0)


def _faint(images: Tensor) -> Tensor:  # (P,)
    """Return how little the images tell of a pixel: 1 where it is dark in all, 0 where it is bright."""
    bright = torch.empty(len(images))
    for part in range(0, len(images), _PART):
        squared = images[part : part + _PART] ** 2
        bright[part : part + _PART] = (squared / (squared + DATA_FLOOR)).mean(dim=(1, 2))
    return 1.0 - bright


def _priors(
    state: State, made: Factors, beside: Neighbours, weights: Weights, part: float
) -> Tensor:  # fmt: skip
    loss = weights.smooth * roughness(made.normals, beside)
    loss = loss + _falling(weights.curl, part) * curl(made.normals, beside)
    loss = loss + weights.albedo * roughness(state.log_albedo, beside)
    loss = loss + weights.body * (state.body.pow(2).sum() + 0.01).sqrt()
    gloss = state.log_strength
    return loss + weights.gloss * (roughness(gloss, beside) + weights.gloss_size * (gloss**2).mean())


def _lights_prior(directions: Tensor, start: Tensor, weights: Weights, part: float) -> Tensor:
    stretch, shift = anchor(directions, start)
    return stretch + _falling(weights.shift, part) * shift


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
