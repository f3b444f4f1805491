"""Images read a few at a time, cropped to the object and exposed as in training, so that memory stays bounded.

Legend: L images, (H, W) their sides, (h, w) the sides of the object's box.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from render.shared.errors import InputError
from render.shared.progress import stage
from render.shared.seeds import generator
from sdps.core.geometry import Capture
from sdps.data.augment import Exposure
from sdps.inference.stray_light import remove_stray_light, stray_light

EXPOSURE_VALUES = 4_000_000
"""Values the exposure is measured on at most; of more, the same random pixels of every image are taken."""
_READ_PIXELS = 2**20
"""Pixels read from a source at once, whole images."""


class ImageSource(Protocol):
    """Linear radiance that is read on demand: an array, a memory-mapped one, a list, or a loader of files.

    It is gone through several times, in order; every image must be the same each time. One that can read a part of its
    images for less than all of them has `window(part, rows, columns)`, the same as `[part][:, rows, columns]`.
    """

    def __len__(self) -> int:
        """Return L, the number of images."""

    def __getitem__(self, part: slice, /) -> np.ndarray:
        """Return the images of `part` (start, stop, no step), (n, H, W, 3) of any real type and overall scale."""


@dataclass(frozen=True, eq=False)
class ObjectImages:
    """The images of an object.

    Attributes:
        source: All images.
        rows, columns: The box around the mask, with its margin, or the whole frame.
        mask: (h, w) bool, the mask inside the box.
        shape: (H, W).
        stray: (L, 3) float32, stray light that is taken off every image; zero where none is.
        sample: (L, P, 3) float32, radiance of object pixels without it: all, or those the exposure is measured on.
    """

    source: ImageSource
    rows: slice
    columns: slice
    mask: np.ndarray
    shape: tuple[int, int]
    stray: np.ndarray
    sample: np.ndarray

    def __len__(self) -> int:
        return len(self.source)

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return images of the box, (stop - start, h, w, 3) float32, without stray light, black outside the mask."""
        images = np.empty((stop - start, *self.mask.shape, 3), np.float32)
        step = _images_at_once(self.mask.shape)  # few copies of large images at a time
        for first in range(start, stop, step):
            last = min(first + step, stop)
            part = slice(first, last)
            found = np.asarray(_window(self.source, part, self.rows, self.columns, self.shape), np.float32)
            images[first - start : last - start] = remove_stray_light(found, self.stray[part])
        # Not a product: outside the mask there may be NaN.
        images[:, ~self.mask] = 0.0
        return images

    def part(self, rows: slice, columns: slice) -> "ObjectImages":
        """Return the images of a part of the box, (rows, columns) of it; exposure and stray light stay the whole's."""
        top, left = self.rows.start, self.columns.start
        rows_of_all = slice(top + rows.start, top + rows.stop)
        columns_of_all = slice(left + columns.start, left + columns.stop)
        return replace(self, rows=rows_of_all, columns=columns_of_all, mask=self.mask[rows, columns])

    def in_frame(self, values: np.ndarray) -> np.ndarray:
        """Return values of the box, (h, w, ...), in the whole frame, (H, W, ...), zero elsewhere."""
        whole = np.zeros((*self.shape, *values.shape[2:]), values.dtype)
        whole[self.rows, self.columns] = values
        return whole

    def parts(self, count: int) -> Iterator[range]:
        """Yield `count` images after `count` images, each time as the starts of what is read at once."""
        step = _images_at_once(self.shape)
        for start in range(0, len(self), count):
            yield range(start, min(start + count, len(self)), step)


def survey(source: ImageSource, mask: np.ndarray, margin: int | None, *, stray: bool = False) -> ObjectImages:
    """Go through all images once: check them, find the object's box, gather what the exposure is measured on.

    Args:
        source: (L, H, W, 3), L >= 1.
        mask: (H, W) bool.
        margin: Pixels kept around the mask's bounding box; None keeps the whole frame.
        stray: Measure stray light, to be taken off.

    Raises:
        InputError: sizes that do not fit, an empty mask, or values that are not finite inside it.
    """
    if not len(source):
        raise InputError("images must be (L, H, W, 3) with L >= 1, got none")
    shape = _read(source, 0, 1).shape[1:3]
    if mask.shape != shape or mask.dtype != np.bool_:
        raise InputError(f"the mask must be bool of shape {shape}, got {mask.dtype} of {mask.shape}")
    if not mask.any():
        raise InputError("the mask is empty; mark the object's pixels")
    chosen = _sample_pixels(int(mask.sum()), len(source))
    sample = np.empty((len(source), len(chosen), 3), np.float32)
    step = _images_at_once(shape)
    for start in range(0, len(source), step):
        stop = min(start + step, len(source))
        inside = _read(source, start, stop, shape)[:, mask]  # (n, P, 3)
        stage("survey", stop, len(source))
        if not np.isfinite(inside).all():
            raise InputError("the images contain NaN or infinite values inside the mask; repair them first")
        sample[start:stop] = inside[:, chosen]
    rows, columns = find_box(mask, margin)
    level = stray_light(sample) if stray else np.zeros((len(source), 3), np.float32)
    return ObjectImages(source, rows, columns, mask[rows, columns], shape, level, remove_stray_light(sample, level))


class Surface(NamedTuple):
    """An object before its camera, and what is known of its depth.

    Attributes:
        capture: The object before its camera.
        heights: (h, w) z in pixels; None: all at the object's mean depth.
    """

    capture: Capture
    heights: np.ndarray | None = None

    def place(self, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return where the pixels of a part lie and how they are seen, (h, w, 3) float32 each."""
        capture, heights = self.capture, 0.0 if self.heights is None else self.heights[rows, columns]
        where = np.arange(rows.start, rows.stop)[:, None], np.arange(columns.start, columns.stop)[None]
        sights = capture.camera.look(capture.shape, *where)
        return capture.place(*where, heights).astype(np.float32), sights.astype(np.float32)


@dataclass(frozen=True, eq=False)
class View:
    """The object's images as a network wants them, in chunks.

    Attributes:
        images: Where they come from.
        exposure: Applied first.
        balance: (L, 3) colours of the lights with mean 1, divided out next; None for white lights.
        fit: Brings images (1, n, 3, h, w) and mask (1, 1, h, w) to the network's size.
        count: Images of a chunk.
        device: Where the tensors go.
        placement: Where the pixels lie and how they are seen, (h, w, 3) each (`sdps.models.base.Placement`); None: it
            does not matter.
    """

    images: ObjectImages
    exposure: Exposure
    balance: np.ndarray | None
    fit: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    count: int
    device: torch.device
    placement: tuple[np.ndarray, ...] | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def mask(self) -> Tensor:
        """The mask at the network's size, (1, 1, h', w') float32; between 0 and 1 on the border if it was resized."""
        return self.fit(torch.zeros(1, 1, 3, *self.images.mask.shape, device=self.device), self._mask())[1]

    @property
    def placed(self) -> tuple[Tensor, ...] | None:
        """The placement at the network's size, (1, 3, h', w') float32 each."""
        if self.placement is None:
            return None
        pictures = (torch.from_numpy(each).to(self.device) for each in self.placement)
        return tuple(self.fit(each.permute(2, 0, 1)[None, None], self._mask())[0][:, 0] for each in pictures)

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield which images, and these, (1, n, 3, h', w') float32."""
        mask = self._mask()
        for starts in self.images.parts(self.count):
            pieces = [self._piece(start, min(start + starts.step, starts.stop), mask) for start in starts]
            yield slice(starts.start, starts.stop), torch.cat(pieces, dim=1) if len(pieces) > 1 else pieces[0]

    def _mask(self) -> Tensor:
        return torch.from_numpy(self.images.mask.astype(np.float32))[None, None].to(self.device)

    def _piece(self, start: int, stop: int, mask: Tensor) -> Tensor:
        images = self.exposure.apply(self.images.read(start, stop))
        if self.balance is not None:
            images /= self.balance[start:stop, None, None]
        # (n, h, w, 3) seen as (n, 3, h, w) is the channels_last layout already.
        tensor = torch.from_numpy(images).to(self.device).permute(0, 3, 1, 2)[None]
        return self.fit(tensor, mask)[0]


def _read(source: ImageSource, start: int, stop: int, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Return images (n, H, W, 3) of the source, or refuse what it gives."""
    images = np.asarray(source[start:stop])
    if images.ndim != 4 or images.shape[-1] != 3 or len(images) != stop - start:
        raise InputError(
            f"images must be (L, H, W, 3) with L >= 1, got {images.shape} for image {start} to before {stop}"
        )
    if shape is not None and images.shape[1:3] != shape:
        raise InputError(
            f"images must be of one size, {shape} as the first, got {images.shape[1:3]} for image {start} to before "
            f"{stop}; crop or resize them"
        )
    return images


def _window(source: ImageSource, part: slice, rows: slice, columns: slice, shape: tuple[int, int]) -> np.ndarray:
    """Return rows and columns of images (n, h, w, 3), of a source that reads no more than these where it can."""
    window = getattr(source, "window", None)
    if window is None:
        return _read(source, part.start, part.stop, shape)[:, rows, columns]
    return np.asarray(window(part, rows, columns))


def _images_at_once(shape: tuple[int, int]) -> int:
    return max(1, _READ_PIXELS // (shape[0] * shape[1]))


def _sample_pixels(pixels: int, images: int) -> np.ndarray:
    """Return which of the object's pixels the exposure is measured on, ascending."""
    wanted = max(1, EXPOSURE_VALUES // (3 * images))
    if wanted >= pixels:
        return np.arange(pixels)
    # Not every n-th pixel: on a mask as wide as a multiple of n that is a few columns only.
    return np.sort(generator(0, "exposure").choice(pixels, wanted, replace=False))


def find_box(mask: np.ndarray, margin: int | None) -> tuple[slice, slice]:
    """Return rows and columns of the box around an object (H, W), `margin` wider and inside; of all without one."""
    found = []
    for axis, length in ((1, mask.shape[0]), (0, mask.shape[1])):
        inside = np.flatnonzero(mask.any(axis=axis))
        room = length if margin is None else margin
        found.append(slice(max(int(inside[0]) - room, 0), min(int(inside[-1]) + 1 + room, length)))
    return found[0], found[1]
