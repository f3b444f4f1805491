"""Classical methods on photographs: all images of the object's box at once, or of some of its rows after others.

Methods that look at each pixel by itself need not see the whole object; the rows they see at once lie evenly over it.
"""

from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from render.shared.progress import repeat, stage
from sdps.classical import registry as classical
from sdps.core.estimate import Estimate
from sdps.inference.image_source import ImageSource, survey

PART_BYTES = 5 * 2**28
"""Memory for the observations that a method which looks at pixels one by one sees at once."""
_BYTES = 60
"""Memory of an observation, one pixel in one image, with its copies; measured."""
_MARGIN = 2


def estimate_bytes(name: str, images: int, box: float) -> float:
    """Return about how much memory a method takes for so many images of a box of so many pixels."""
    whole = _BYTES * images * box
    return min(whole, PART_BYTES) if classical.METHODS[name].by_pixel else whole


def run_on_box(name: str, images: ImageSource, mask: np.ndarray, given: tuple[Any, ...]) -> Estimate:
    """Run a classical method on the object's box; arguments as of `sdps.classical.registry.run`."""
    scene = survey(images, mask, _MARGIN)
    count = 1
    if classical.METHODS[name].by_pixel:
        count = min(ceil(_BYTES * len(images) * scene.mask.size / PART_BYTES), len(scene.mask))
    normals, estimate = np.zeros((*mask.shape, 3), np.float32), None
    for number in range(count):
        rows = slice(number, None, count)
        inside = scene.mask[rows]
        if not inside.any():
            continue
        part = replace(scene, rows=slice(scene.rows.start + number, scene.rows.stop, count), mask=inside)
        with repeat(number, count):
            estimate = classical.run(name, part.read(0, len(images)), inside, *given)
            stage("normals", 1, 1)
        normals[scene.rows, scene.columns][rows] = estimate.normals
    assert estimate is not None  # the mask is not empty
    return replace(estimate, normals=normals)
