"""`sdps infer --dry-run`: what was understood of a folder, and what would be done, before anything is."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sdps.core.geometry import Capture

if TYPE_CHECKING:
    from sdps.photos import Photographs
    from sdps.surface.workload import Workload


def list_input(photos: "Photographs") -> dict[str, str]:
    """Say, by name: kind of files, curve, object, lights, camera and size."""
    share, mask = photos.mask.mean(), photos.mask
    curves = {"linear": "linear, taken as it is", "srgb": "sRGB, taken off"}
    curve = curves.get(str(photos.gamma), f"a power of {photos.gamma}, taken off")
    sides = [int(np.ptp(np.flatnonzero(mask.any(axis=axis)))) + 1 for axis in (1, 0)]
    where = "the whole frame" if mask.all() else f"{sides[1]}x{sides[0]} pixels around it, {share:.0%} of the frame"
    return {
        "files": f"{photos.files[0]} to {photos.files[-1]}, {photos.coding}",
        "curve": curve,
        "object": f"{int(mask.sum()):,} pixels, {where}; mask: {photos.mask_origin}",
        "lights": _name_lights(photos),
        "camera": photos.camera_summary,
        "size": _name_size(photos),
    }


def list_work(expected: "Workload", out: str | Path) -> dict[str, str]:
    """Say, by name: method, stages with their time, and the files to come."""
    return {
        "method": expected.method,
        "stages": expected.describe_stages(),
        "results": f"{', '.join(expected.files)}, report.html into {out}",
    }


def write_rows(rows: dict[str, str]) -> str:
    """Return a line of each."""
    return "".join(f"{name}: {text}\n" for name, text in rows.items())


def _name_lights(photos: "Photographs") -> str:
    """Say what is known of the lights."""
    found = photos.light_directions is None
    strengths = "not known" if photos.intensities is None else "given"
    return f"directions {'not known' if found else f'from {photos.lights_name}'}; intensities {strengths}"


def _name_size(photos: "Photographs") -> str:
    """Say how large a pixel is, where that is known."""
    if photos.pixel_size is None:
        return "not known (--pixel-size); depth is in pixels"
    across = 2.0 * Capture.of(photos.mask, photos.camera).radius * photos.pixel_size
    return f"{photos.pixel_size:.4g} mm a pixel; the object is {across:.4g} mm long"
