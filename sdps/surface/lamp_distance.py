"""How far away the lamps stood, in words and numbers for people."""

from typing import Any, Literal

import numpy as np

from sdps.core.geometry import FAR

Origin = Literal["given", "found", "assumed"]
_ALIKE = 1.05  # furthest over nearest, up to which lamps share a distance


def measure_distances(nearness: np.ndarray | None, count: int) -> np.ndarray:  # (L,)
    """Return the lamps' distances in object sizes, float64, inf of distant ones; None: all `count` are."""
    distances = np.full(count, np.inf)
    if nearness is not None:
        np.divide(0.5, nearness, out=distances, where=nearness > FAR)  # the radius is half a size
    return distances


def describe_lamps(distances: np.ndarray, origin: Origin, millimetres: float | None = None) -> dict[str, Any]:
    """Say how far away the lamps stood, JSON ready.

    Args:
        distances: (L,) of `measure_distances`.
        origin: `given` by the user, `found`, or `assumed` by a method that only knows distant lamps.
        millimetres: Size of the object; None where it is not known.

    Returns:
        `text`, a sentence without capital and full stop; `origin`; `far`, whether no lamp was near. Of near lamps also
        `distance_in_object_sizes`, their median; where they differ `nearest` and `furthest`; `distance_in_millimetres`
        of an object whose size is known; and `far_lamps`, the number of the others, if there are any.
    """
    near, given = distances[np.isfinite(distances)], ", as given" if origin == "given" else ""
    if not len(near):
        far = {"given": "stood far away", "found": f"stood far away, over {0.5 / FAR:g} object sizes",
               "assumed": "were taken for far away"}  # fmt: skip
        return {"text": f"the lamps {far[origin]}{given}", "origin": origin, "far": True}
    middle, least, most = (float(value) for value in (np.median(near), near.min(), near.max()))
    facts = {"origin": origin, "far": False, "distance_in_object_sizes": round(middle, 2)}
    sizes = f"{_round(middle)} object size{'' if _round(middle) == '1' else 's'}"
    if millimetres is not None:
        facts["distance_in_millimetres"] = round(middle * millimetres, 1)
        sizes += f" ({_round(middle * millimetres)} mm)"
    text = f"the lamps stood about {sizes} away"
    if most > _ALIKE * least:
        facts |= {"nearest": round(least, 2), "furthest": round(most, 2)}
        text += f", the nearest {_round(least)}, the furthest {_round(most)}"
    others = len(distances) - len(near)
    if others:
        facts["far_lamps"] = others
        text += f", and {others} far away"
    return {"text": text + given} | facts


def _round(value: float) -> str:
    """Return two digits that count."""
    return f"{float(f'{value:.2g}'):g}"
