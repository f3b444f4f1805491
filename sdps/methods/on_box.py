"""Classical methods on photographs: all images of the object's box at once, or of some of its rows after others.

Methods that look at each pixel by itself need not see the whole object; the rows they see at once lie evenly over it.
"""

from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from render.shared.progress import repeat, stage
from sdps.classical import registry as classical
from sdps.classical.common.near_lamps import NearLamps
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


class Box:
    """Images of an object's box, for one run of a classical method or several; read once where they fit into memory.

    Args:
        name: The method.
        images: (L, H, W, 3).
        mask: (H, W) bool.
    """

    def __init__(self, name: str, images: ImageSource, mask: np.ndarray) -> None:
        self.name, self.mask, self.scene = name, mask, survey(images, mask, _MARGIN)
        self.count = 1
        self.kept: np.ndarray | None = None
        if classical.METHODS[name].by_pixel:
            pixels = self.scene.mask.size
            self.count = min(ceil(_BYTES * len(images) * pixels / PART_BYTES), len(self.scene.mask))

    def run(self, given: tuple[Any, ...], near: NearLamps | None = None) -> Estimate:
        """Run the method; arguments as of `sdps.classical.registry.run`, `near` with the places of all pixels."""
        scene, mask = self.scene, self.mask
        lights, intensities = given or (None, None)
        boxed = None if near is None else near.at((scene.rows, scene.columns))
        normals, estimate = np.zeros((*mask.shape, 3), np.float32), None
        for number in range(self.count):
            rows = slice(number, None, self.count)
            inside = scene.mask[rows]
            if not inside.any():
                continue
            with repeat(number, self.count):
                images, lamps = self._read(number, inside), None if boxed is None else boxed.at(rows)
                estimate = classical.run(self.name, images, inside, lights, intensities, lamps)
                stage("normals", 1, 1)
            normals[scene.rows, scene.columns][rows] = estimate.normals
        assert estimate is not None  # the mask is not empty
        return replace(estimate, normals=normals)

    def _read(self, number: int, inside: np.ndarray) -> np.ndarray:
        """Read every `count`-th row of the box, from a number on; of all rows, once."""
        if self.kept is not None:
            return self.kept
        scene = self.scene
        part = replace(scene, rows=slice(scene.rows.start + number, scene.rows.stop, self.count), mask=inside)
        images = part.read(0, len(scene))
        if self.count == 1:
            self.kept = images
        return images
