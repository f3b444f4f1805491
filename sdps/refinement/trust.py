"""How far refinement can be trusted: the errors to expect of it and of its start, and reasons to keep the start.

The formulas were fitted on rendered scenes of shapes and lights that no network was trained on, by
`lab/studies/refinement_study.py --fit`; docs/studies/refinement.md shows expected against actual errors.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from sdps.core.estimate import Estimate
from sdps.core.geometry import are_near
from sdps.core.metrics import angle_degrees
from sdps.inference.tiles import split
from sdps.refinement.image_model import Refined

FEWEST_IMAGES = 8
"""With fewer, what a method found is kept."""
_PLANE = 0.08
"""Lights are taken to lie in one plane with the object if they leave it by less, root mean square."""
_TURNED = 2.0
"""Lights went astray if they moved by so many times what the network expects them to be off: of 46 rendered scenes
those of two mirrors moved by 2.4 and 2.6 times that, to where they were worse, others by at most 1.5."""
_FLAT = 0.1
"""An object is taken to be flat if its normals spread by less, root mean square."""
_WINDOW = 5  # pixels that a residual is averaged over
_BEST, _LEAST = 0.008, 0.001  # the residual of a perfect model, and the least above it that is told apart
_PART = 2**20  # pixels worked on at once
_UPRIGHT, _STILL, _FAINT = 0.1, 0.3, 0.003
_GIVEN = 0.8  # share of the error that is left where light directions are given and no network tells what it expects

NORMAL = (4.804, 0.613, -0.505, 0.232, 0.016, -0.310, 0.298)
"""Of log degrees per pixel: constant, misfit, images, the lights' spread, residual of the pixel, its n_z, how far its
normal has moved."""
NORMAL_TOLD = (0.094, 0.220, -0.251, -0.588, 0.090, -0.300, 0.026, 0.448, 0.872)
"""The same where the network of the start told which errors it expects; the normal's own and their mean come last."""
LIGHT = (5.172, 0.636, -0.477, -0.014, 0.147, 0.072)
"""Of log degrees per light: constant, misfit, images, the lights' spread, residual of its image, how far it has moved.
"""
START = (0.324, 0.065, 1.030)
"""Of the start's log mean degrees: constant, misfit, how far the normals have moved."""


class Trust(NamedTuple):
    """What to expect.

    Attributes:
        normals: (H, W) float32, expected error in degrees, zero outside the mask.
        lights: (L,) float32, expected error in degrees; None where the directions were given: they may be exact or not.
        start: Expected mean error of the start's normals in degrees.
        doubt: Why the start is to be kept, in one line; empty where refinement is better.
        void: Refinement's word is worth nothing anywhere, so it is not joined either: photographs such as these cannot
            show the shape, or the lights went astray.
        plain: (H, W) float32, `normals` by what refinement left over alone, without the network's word.
    """

    normals: np.ndarray
    lights: np.ndarray | None
    start: float
    doubt: str
    void: bool
    plain: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedEstimate(Estimate):
    """An estimate after refinement: what refinement found, or its start where there is a doubt.

    Attributes:
        refined: What refinement found, kept or not.
        start: What it began with.
        trust: What to expect of it.
    """

    refined: Refined
    start: Estimate
    trust: Trust


def choose(start: Estimate, refined: Refined, expected: Trust) -> RefinedEstimate:
    """Return what refinement found, or its start where there is a doubt; and the error to expect of it."""
    values = vars(start) | {"start": start, "refined": refined, "trust": expected}
    if not expected.doubt or start.expected_error is None:
        values["expected_error"] = expected.normals
    if not expected.doubt:
        values["normals"], values["light_directions"] = refined.normals, refined.light_directions
        values["intensities"] = refined.grey_intensities
        values["nearness"] = refined.nearness if are_near(refined.nearness) else None
    return RefinedEstimate(**values)


def trust(found: Refined, mask: np.ndarray, start: Estimate, *, given: bool = False, level: bool = False) -> Trust:
    """Return the errors to expect of what refinement found.

    Args:
        found: What it found.
        mask: (H, W) bool.
        start: Its start; where a network predicts them, with its expected errors.
        given: The light directions were given: less is expected to be off, of lights nothing is said, and the start is
            kept for no error that is expected.
        level: The object's mean plane faces the camera.
    """
    of_lights, moved, parts = _features(found, mask, start)
    told, plainly, values = start.expected_error is not None, [], []
    for of_normals in parts:
        plainly.append(np.exp(of_normals[:, : len(NORMAL)] @ NORMAL))
        values.append(np.exp(of_normals @ NORMAL_TOLD) if told else (_GIVEN if given else 1.0) * plainly[-1])
    expected, plain = np.zeros((2, *mask.shape), np.float32)
    expected[mask], plain[mask] = np.concatenate(values), np.concatenate(plainly)
    of_start, mean = float(np.exp(moved @ START)), float(plain[mask].mean())
    void = _find_blindness(mask, start.normals, start.light_directions, tilted=not (given or level))
    void = void or _find_turn(found.light_directions, start)
    doubt = void or _count_images(len(found.light_directions))
    # What a network tells raises both sides, so it is left out here.
    if not doubt and not given and mean > of_start:
        doubt = f"the model does not explain the photographs: {mean:.1f} degrees expected, {of_start:.1f} without it"
    of_light = None if given else np.exp(of_lights @ LIGHT).astype(np.float32)
    return Trust(expected, of_light, of_start, doubt, bool(void), plain)


def features(found: Refined, mask: np.ndarray, start: Estimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `NORMAL` (P, 7) or `NORMAL_TOLD` (P, 9), `LIGHT` (L, 6) and `START` (3,) are multiplied with;
    arguments as of `trust`.
    """
    of_lights, moved, parts = _features(found, mask, start)
    return np.concatenate(list(parts)), of_lights, moved


def measure_spread(lights: np.ndarray) -> float:
    """Return how far lights (L, 3) lie from their mean, root mean square."""
    return float(np.sqrt(max(lights.var(axis=0).sum(), _LEAST)))


def _features(found: Refined, mask: np.ndarray, start: Estimate) -> tuple[np.ndarray, np.ndarray, Iterator[np.ndarray]]:
    """Return the features of lights, start and pixels, these a part at a time."""
    normals, lights = start.normals, start.light_directions
    images = len(lights)
    residual = float(found.pixel_residual[mask].mean())
    misfit, count = np.log(max(residual - _BEST, _LEAST)), np.log(images)
    spread = np.log(measure_spread(found.light_directions))
    share = ndimage.uniform_filter(mask.astype(np.float32), _WINDOW)[mask]
    around = ndimage.uniform_filter(np.where(mask, found.pixel_residual, 0.0), _WINDOW)[mask] / share
    turned = angle_degrees(found.normals[mask], normals[mask])
    own = start.expected_error
    told, facing = None if own is None else own[mask], found.normals[..., 2][mask]

    def of_normals(part: slice) -> np.ndarray:
        pixels = len(turned[part])
        columns = [
            np.ones(pixels), np.full(pixels, misfit), np.full(pixels, count), np.full(pixels, spread),
            np.log((around[part] + _FAINT) / residual), np.log(np.maximum(facing[part], _UPRIGHT)),
            np.log(turned[part] + _STILL),
        ]  # fmt: skip
        if told is not None:
            columns += [np.log(told[part] + _STILL), np.full(pixels, np.log(told.mean() + _STILL))]
        return np.stack(columns, axis=1)

    shifted = angle_degrees(found.light_directions, lights)
    of_lights = np.stack([
        np.ones(images), np.full(images, misfit), np.full(images, count), np.full(images, spread),
        np.log(found.image_residual / residual), np.log(shifted + _STILL),
    ], axis=1)  # fmt: skip
    parts = split(len(turned), _PART)
    moved = np.array([1.0, misfit, np.log(turned.mean() + _STILL)])
    return of_lights, moved, (of_normals(part) for part in parts)


def _count_images(images: int) -> str:
    """Return that these are too few, if they are."""
    if images >= FEWEST_IMAGES:
        return ""
    return f"{images} images are too few to refine with; {FEWEST_IMAGES} are needed"


def _find_turn(lights: np.ndarray, start: Estimate) -> str:
    """Return that refined lights (L, 3) moved further than the network's can be off, if they did.

    Wrong lights and wrong normals explain the photographs of a mirror about as well as right ones; the network has seen
    many, and knows how far off its lights are. Given lights do not move.
    """
    if start.expected_light_error is None:
        return ""
    expected = float(start.expected_light_error.mean())
    turned = float(angle_degrees(lights, start.light_directions).mean())
    if turned <= _TURNED * expected:
        return ""
    return f"it turned the lights by {turned:.0f} degrees, which the network expects to be off by only {expected:.0f}"


def are_even(normals: np.ndarray) -> bool:
    """Return whether normals (P, 3) are those of a flat object: they hardly spread."""
    return float(np.sqrt(np.square(normals - normals.mean(axis=0)).sum(axis=1).mean())) < _FLAT


def _find_blindness(mask: np.ndarray, normals: np.ndarray, lights: np.ndarray, *, tilted: bool = True) -> str:
    """Return why photographs such as these cannot show the shape, or nothing; `tilted`: its tilt is not known."""
    if np.linalg.svd(lights, compute_uv=False)[-1] / np.sqrt(len(lights)) < _PLANE:
        return "the lights lie in one plane with the object, so photographs cannot show its shape"
    if tilted and are_even(normals[mask]):
        return "the object is flat, so photographs cannot show its tilt apart from the lights' directions"
    return ""
