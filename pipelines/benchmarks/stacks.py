"""Images of an object that stay on disk until they are asked for, cut to the object and black around it."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from render.exchange.ingest import Box
from render.shared.errors import InputError
from render.shared.files import read_bytes

MARGIN = 15
"""Pixels kept around the mask's bounding box, as the published results do (SDPS-Net's preparation of DiLiGenT)."""


_KEPT_BYTES = 2**30


@dataclass(frozen=True, eq=False)
class Stack:
    """Linear images, an `sdps.inference.image_source.ImageSource`.

    Attributes:
        read: Reads image number k whole, (H, W, 3) float32 linear radiance; raises InputError.
        names: What image k is called, for complaints.
        full_mask: (H, W) bool, of the whole frame.
        box: The part that is kept.
        longest: Greatest side in pixels; larger images are averaged down. 0 for no limit.
    """

    read: Callable[[int], np.ndarray]
    names: Sequence[str]
    full_mask: np.ndarray
    box: Box
    longest: int = 0

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, part: slice) -> np.ndarray:  # (n, h, w, 3) float32
        mask = self.box.cut(self.full_mask)
        return np.stack([self._shrunk(self._cut(k) * mask[..., None]) for k in range(*part.indices(len(self)))])

    def opened(self) -> "np.ndarray | Stack":
        """Read every image, so that no method is blamed for a damaged file; of a large stack none is kept.

        Returns:
            The images (L, h, w, 3) float32, or the stack itself where they would take more than a gibibyte.

        Raises:
            InputError: a picture that is missing, damaged or of another size.
        """
        if 12 * len(self) * self.mask.size <= _KEPT_BYTES:
            return self[0 : len(self)]
        for number in range(len(self)):
            self._cut(number)
        return self

    @property
    def mask(self) -> np.ndarray:
        """The mask at the size of the images, (h, w) bool."""
        return self._shrunk(self.box.cut(self.full_mask).astype(np.float32)) > 0.5

    def _cut(self, number: int) -> np.ndarray:
        image = self.read(number)
        if image.shape[:2] != self.full_mask.shape:
            raise InputError(
                f"{self.names[number]}: is {image.shape[0]}x{image.shape[1]}, the mask is {self.full_mask.shape[0]}x"
                f"{self.full_mask.shape[1]} (height x width); give all pictures of an object one size"
            )
        return np.nan_to_num(self.box.cut(image), nan=0.0, posinf=0.0, neginf=0.0)

    def _shrunk(self, image: np.ndarray) -> np.ndarray:
        side = max(image.shape[:2])
        if not self.longest or side <= self.longest:
            return image
        height, width = (max(1, round(extent * self.longest / side)) for extent in image.shape[:2])
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def files_digest(files: Sequence[Path], *settings: Any) -> str:
    """Return a digest of files' bytes, in order, and of settings.

    Raises:
        InputError: a missing or unreadable file.
    """
    digest = hashlib.sha256(repr(settings).encode())
    for path in files:
        digest.update(hashlib.sha256(read_bytes(path)).digest())
    return digest.hexdigest()[:24]
