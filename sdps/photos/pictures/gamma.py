"""Which curve lies between radiance and the values of a folder's files."""

from collections.abc import Sequence
from pathlib import Path

from render.shared.errors import InputError
from sdps.photos.pictures.listing import find_light_files
from sdps.photos.pictures.picture_kinds import LOSSY, Coding
from sdps.photos.pictures.profiles import name_curve

_EXPONENTS = (0.3, 4.0)
"""Exponents that are taken for a display curve."""


def resolve_gamma(gamma: str | float, coding: Coding, folders: Sequence[Path]) -> tuple[str | float, str]:
    """Return the curve to take off (linear, srgb or an exponent) and a sentence that says why.

    Args:
        gamma: As of `load`.
        coding: Of the photographs.
        folders: Where they and other files lie.

    Raises:
        InputError: a gamma that is none.
    """
    if str(gamma) != "auto":
        applied = _read_gamma(gamma)
        return applied, f"values are taken as {_words(applied)}, as you said"
    if coding.floating:
        return "linear", f"values are taken as linear, because the files are {coding}"
    if coding.kind == "RAW":
        return "linear", (
            "camera RAW is developed linearly, all pictures alike: daylight white balance, the sensor's own colours"
        )
    if coding.curve is not None:
        applied, about = name_curve(coding.curve), "about " if coding.rough else ""
        stay = f"; colours stay in its primaries ({coding.primaries})" if coding.primaries else ""
        return applied, f"values are taken as {about}{_words(applied)}, because the files' colour profile says so{stay}"
    if coding.bits == 16:
        return "linear", "values are taken as linear, because 16-bit files without colour profile mostly are"
    listed = [name for folder in folders for name in find_light_files(folder)]
    if coding.kind not in LOSSY and listed:
        return "linear", f"values are taken as linear, because {listed[0]} marks a benchmark's folder"
    return (
        "srgb",
        f"values are taken as sRGB, because the files are {coding}; if they are linear, say so (gamma linear)",
    )


def _read_gamma(gamma: str | float) -> str | float:
    if str(gamma) in ("linear", "srgb"):
        return str(gamma)
    try:
        value = float(gamma)
    except ValueError as error:
        raise InputError(f"gamma {gamma!r} is none of auto, linear, srgb and no exponent like 2.2") from error
    if not _EXPONENTS[0] <= value <= _EXPONENTS[1]:
        raise InputError(f"gamma {value:g} is not a display curve; give an exponent like 2.2, linear, srgb or auto")
    return value


def _words(gamma: str | float) -> str:
    """Name a curve in a sentence."""
    return {"linear": "linear", "srgb": "sRGB"}.get(str(gamma)) or f"raised to the power {gamma:.3g}"
