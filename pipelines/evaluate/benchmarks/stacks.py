"""Photographs of an object that stay on disk until they are asked for, cut to the object and black around it."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from pipelines.evaluate.evaluation import TestObject
from render.exchange.ingest import Box, crop_box
from render.shared.errors import InputError
from render.shared.files import read_bytes
from sdps.core.geometry import Camera

MARGIN = 15
"""Pixels kept around the mask's bounding box, as the published results do (SDPS-Net's preparation of DiLiGenT)."""

_KEPT_BYTES = 2**30


class Images(NamedTuple):
    """Images on disk.

    Attributes:
        read: Reads image number k whole, (H, W, 3) float32 linear radiance; raises InputError.
        files: Everything they are read from.
        names: What image k is called, for complaints.
    """

    read: Callable[[int], np.ndarray]
    files: Sequence[Path]
    names: Sequence[str]

    @classmethod
    def of_files(cls, files: Sequence[Path], read: Callable[[Path], np.ndarray]) -> "Images":
        """Return images of a file each."""
        return cls(lambda number: read(files[number]), files, [str(path) for path in files])


@dataclass(frozen=True, eq=False)
class Stack:
    """Linear images, an `sdps.inference.image_source.ImageSource`.

    Attributes:
        images: The images as they are on disk.
        full_mask: (H, W) bool, of the whole frame.
        box: The part that is kept.
        longest: Greatest side in pixels; larger images are averaged down. 0 for no limit.
    """

    images: Images
    full_mask: np.ndarray
    box: Box
    longest: int = 0

    def __len__(self) -> int:
        return len(self.images.names)

    def __getitem__(self, part: slice) -> np.ndarray:  # (n, h, w, 3) float32
        mask = self.box.cut(self.full_mask)
        return np.stack([self._shrunk(self._cut(k) * mask[..., None]) for k in range(*part.indices(len(self)))])

    def open(self) -> "np.ndarray | Stack":
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
        image = self.images.read(number)
        if image.shape[:2] != self.full_mask.shape:
            found, wanted = ("x".join(map(str, array.shape[:2])) for array in (image, self.full_mask))
            raise InputError(
                f"{self.images.names[number]}: is {found}, the mask is {wanted} (height x width); give all pictures of "
                "an object one size"
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


def build_object(
    name: str,
    images: Images,
    mask: np.ndarray,
    directions: np.ndarray,
    intensities: np.ndarray | None = None,
    *,
    normals: np.ndarray | None = None,
    margin: int = MARGIN,
    longest: int = 0,
    files: Sequence[Path] = (),
    settings: tuple[object, ...] = (),
    camera: Camera | None = None,
) -> TestObject:
    """Return an object of which the lights are known; its images stay on disk.

    Args:
        name: The object.
        images: L images.
        mask: (H, W) bool.
        directions: (L, 3), from the surface to the light, of any length.
        intensities: (L, 3), None where they are not known.
        normals: (H, W, 3) true normals, None where they are not known.
        margin: Pixels kept around the mask's bounding box.
        longest: Greatest side in pixels, 0 for no limit.
        files: What else the object comes from, such as its mask.
        settings: What else its images depend on.
        camera: Of whole pictures.
    """
    box = crop_box(mask, margin)
    stack = Stack(images, mask, box, longest)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    gains = None if intensities is None else intensities.tolist()
    return TestObject(
        name=name, digest=files_digest([*images.files, *files], *settings, margin, longest, directions.tolist(), gains),
        load=lambda: stack, mask=stack.mask, normals=None if normals is None else box.cut(normals),
        light_directions=directions.astype(np.float32), intensities=intensities,
        camera=None if camera is None else camera.crop(mask.shape, box.top, box.left),
    )  # fmt: skip
