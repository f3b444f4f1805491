"""The lights that balls give, as those of a file: directions, intensities, distances, and what to say of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from render.shared.errors import InputError, list_names
from sdps.core.geometry import Capture
from sdps.photos.analysis.balls.ball_depths import join_balls
from sdps.photos.analysis.balls.ball_flags import FLAG
from sdps.photos.analysis.balls.ball_lights import OUTLINED, BallLights, BallRays
from sdps.photos.light_files.light_choice import EQUAL, KnownLights
from sdps.photos.light_files.light_distance import FLAG as DISTANCE
from sdps.photos.light_files.light_distance import LightDistance, Yardstick

_ENOUGH = 2 / 3  # share of the pictures that must have a light
_APART = 3.0  # degrees by which rays of balls may miss one another
_GREY = 0.02  # relative deviation of the channels from which on a lamp has a colour


@dataclass(frozen=True, eq=False)
class LightsOfBalls:
    """Lights that balls give.

    Attributes:
        known: Of the pictures that are kept, and notes.
        kept: Which pictures have a light, (L,) bool.
        notes: Which pictures are left out, and why.
    """

    known: KnownLights
    kept: np.ndarray
    notes: tuple[str, ...]


def know_lights(
    rays: Sequence[BallRays], names: str, files: Sequence[str], capture: Capture, known: KnownLights,
    distance: LightDistance, by: Yardstick,
) -> LightsOfBalls:  # fmt: skip
    """Return the lights that balls give.

    Args:
        rays: What each says, at least one.
        names: The balls in words.
        files: (L,) names of the pictures.
        capture: The object.
        known: What is known without balls: intensities.
        distance: What the user says of how far the lamps are.
        by: What turns distances into radii of the object.

    Raises:
        InputError: too few pictures with a light.
    """
    distant, reach = distance.distance == np.inf, None
    if distance.distance is not None and not distant:
        reach = float(by.radii(np.array([distance.distance]), distance.unit, DISTANCE)[0]) / 2.0
    found, depths = join_balls(rays, capture, distant, reach, by.pixel_size)
    kept = found.kept
    if kept.mean() < _ENOUGH:
        bad = [name for name, good in zip(files, kept.tolist(), strict=True) if not good]
        raise InputError(f"{FLAG}: no light for {list_names(bad, 6)} of {len(files)} pictures; correct the circle")
    strengths = _compress(found.intensities[kept]) if found.intensities is not None else None
    given = known.intensities
    if given is not None:
        strengths = given[kept]
    lights = replace(
        known, directions=found.directions[kept].astype(np.float32), intensities=strengths, name=names,
        distances=None if found.distances is None else found.distances[kept],
        unit="" if found.distances is None else "objects",
        notes=(*_describe(found, names, known, strengths, _say_depths(rays, depths), by), *_doubt_circles(rays)),
    )  # fmt: skip
    return LightsOfBalls(lights, kept, _name_left(files, found))


def _describe(
    found: BallLights, names: str, known: KnownLights, strengths: np.ndarray | None, where: str, by: Yardstick
) -> tuple[str, ...]:
    """Say where the lights are from."""
    notes = [f"lights are those that {names} shows" if " and " not in names else f"lights are those that {names} show"]
    if found.apart is not None:
        doubt = "; a circle may be wrong, or a ball stands much nearer to the camera than the other"
        notes.append(f"the balls' rays agree to {found.apart:.1f} degrees{doubt if found.apart > _APART else ''}")
    if found.distances is not None and np.isfinite(found.distances).any():
        near = found.distances[np.isfinite(found.distances)]
        each = "" if by.pixel_size is None else 2.0 * by.radius * by.pixel_size
        metric = "" if not each else f" ({near.min() * each:.3g} to {near.max() * each:.3g} mm)"
        notes.append(
            f"the lamps stand {near.min():.3g} to {near.max():.3g} object sizes{metric} from its middle, where the "
            f"balls' rays meet ({where})"
        )
    elif where.startswith("by"):
        notes.append(where)
    if strengths is None:
        notes.append(f"a chrome ball gives no intensities; a network finds them (--intensities {EQUAL} if all are)")
    return (*notes, *(note for note in known.notes if note not in KnownLights.notes))


def _say_depths(rays: Sequence[BallRays], depths: np.ndarray | None) -> str:
    """Say how far from the camera the balls stand."""
    if depths is None:
        return "the balls' middles are taken to stand as far from the camera as the object's"
    parts = " and ".join(f"{depth:.3g}" for depth in depths)
    if all(ray.millimetres is not None for ray in rays):
        one = "ball stands" if len(rays) == 1 else "balls stand"
        return f"by their radii the {one} {parts} times as far from the camera as the object"
    return f"the balls are taken for ones of one size, {parts} times as far from the camera as the object"


def _doubt_circles(rays: Sequence[BallRays]) -> list[str]:
    """Say which balls have no outline."""
    bare = [ray.kind for ray in rays if ray.view.outlined < OUTLINED]
    return [f"hardly any outline is seen around the {kind} ball; look whether its circle is right" for kind in bare]


def _name_left(files: Sequence[str], found: BallLights) -> tuple[str, ...]:
    """Say which pictures are left out."""
    left = [f"{name} ({why})" for name, why in zip(files, found.faults, strict=True) if why]
    return (f"left out: {', '.join(left)}",) if left else ()


def _compress(values: np.ndarray) -> np.ndarray:
    """Return intensities (n, 3) as float32, (n,) where no lamp has a colour of its own."""
    grey = values.mean(-1)
    coloured = np.abs(values / grey[:, None] - 1.0).max() > _GREY
    return (values if coloured else grey).astype(np.float32)
