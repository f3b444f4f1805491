"""What to say of a file of lights once the photographs have been asked."""

from collections.abc import Sequence

import numpy as np

from render.shared.errors import list_names
from sdps.methods.given_lights import AXES, LightFit, Reading
from sdps.photos.light_files.light_frame import frame_matrix, frame_name

_FAR = 30.0
"""Degrees between given lights and those a network finds above which they are probably not of these photographs."""
_SAID = "the lights that a network finds in the photographs"


def advise(fit: LightFit, files: Sequence[str], name: str, frame: str, remedy: str = "") -> tuple[str, str]:
    """Return how grave it is that lights do not fit (`error`, `warning` or `note`), and a sentence with the remedy.

    Args:
        fit: What the photographs say of the lights.
        files: (L,) names of the pictures.
        name: Name of the file of lights.
        frame: The frame flag it was read with; empty where the file states its own frame.
        remedy: What to do where they do not fit and are of no file; empty for the lights of one.
    """
    apart, better = fit.given.apart, fit.better
    if better is not None:
        remedies = [text for text in (_order(better, files), _axes(better, frame, fit.sure)) if text]
        return "error", (
            f"the lights of {name} do not fit the photographs: they are {apart:.0f} degrees from {_SAID}; "
            f"{remedy or ', and '.join(remedies)}"
        )
    if not fit.sure and not remedy:
        turned = _flag(AXES[3], frame)
        return "note", (
            f"the lights of {name} are half a turn from {_SAID}; without an outline nothing shows which is right: "
            f"if hollows come out as bumps, {turned}"
        )
    if apart > _FAR:
        return "warning", (
            f"the lights of {name} are {apart:.0f} degrees from {_SAID}, and no other reading of the file fits better; "
            "are they those of these photographs?"
            if not remedy
            else f"the lights of {name} are {apart:.0f} degrees from {_SAID}; {remedy}"
        )
    return "note", f"the lights of {name} are {apart:.0f} degrees from {_SAID}, on average"


def _order(better: Reading, files: Sequence[str]) -> str:
    """Say in which order the rows fit."""
    if not better.sorting:
        return ""
    owners = [files[int(place)] for place in np.argsort(better.order)]  # the picture of each row
    first = ", ".join(owners[:4]) + (", ..." if len(owners) > 4 else "")
    how = {
        "sorted": "the rows fit in the order of names sorted as text",
        "reversed": "the rows fit in reversed order",
        "other": "the rows fit other pictures",
    }[better.sorting]
    said = f" ({first})" if better.sorting != "other" else f" ({list_names(owners, 8)})"
    return f"{how}{said}; write each picture's name before its row"


def _axes(better: Reading, frame: str, sure: bool) -> str:
    """Say after which turn of the axes the lights fit."""
    if (better.axes == AXES[0]).all():
        return ""
    said = f"they fit ({better.apart:.0f} degrees) after {_flag(better.axes, frame, '')}"
    if not sure:
        said += f", or, if hollows then come out as bumps, after {_flag(AXES[3] @ better.axes, frame, '')}"
    return said


def _flag(axes: np.ndarray, frame: str, verb: str = "use ") -> str:
    """Return the flag that turns axes, or what to do to a file that states its own."""
    name = frame_name(axes @ frame_matrix(frame or "y-up"))
    if frame:
        return f"{verb}--frame {name}"
    deeds = {"x-left": "the sign of x", "y-down": "the sign of y", "z-away": "the sign of z", "xy-swapped": "x with y"}
    return ("change " if verb else "a change of ") + " and ".join(
        deeds.get(flag, "nothing") for flag in name.split(",")
    )
