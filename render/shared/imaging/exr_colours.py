"""The colours of an OpenEXR file: of the right layer and part, on the whole display window.

Renderers write many layers into a file, under names of their own: `ViewLayer.Combined.R` (Blender), `beauty.R`, a part
`rgba` with plain `R`. A file may store less than the picture, the data window, or more; what is not stored is 0.
"""

import io
import re
import threading
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from render.shared.decoding import decoding, exr_parts, silence
from render.shared.errors import InputError

_PRINTING = threading.Lock()
"""OpenEXR's binding prints to Python's standard output, which one thread at a time may exchange."""

_LIGHT: tuple[tuple[str, ...], ...] = (
    ("R", "G", "B"), ("RED", "GREEN", "BLUE"), ("Y",), ("V",), ("L",), ("GRAY",), ("GREY",), ("LUMINANCE",),
)  # fmt: skip
"""Channels that are light, in capitals, the first that are there."""

_PREFERRED = ("combined", "beauty", "rgba", "rgb", "composite", "color", "colour", "image", "final")
_OTHERS = re.compile(
    r"crypto|normal|denois|depth|position|motion|vector|velocity|\buv\b|^[nzp]$|\bmask\b|\bmatte\b|objectid|index|\bmist\b",
    re.I,
)
"""Layers that hold something else than light."""


@dataclass(frozen=True, eq=False)
class ExrColours:
    """The light of a picture.

    Attributes:
        pixels: (H, W, 3) or, of a picture without colours, (H, W, 1); float16 or float32, linear.
        alpha: (H, W) of the same type, None where there is none.
        layer: Which layer or part it was, empty where it has no name.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    layer: str


@dataclass(frozen=True, eq=False)
class _Layer:
    """Channels that belong together, colours or one grey, and perhaps alpha."""

    name: str
    channels: tuple[Any, ...]
    alpha: Any
    header: dict[str, Any]


def read_exr_colours(path: str | Path, remedy: str = "copy it again") -> ExrColours:
    """Read the layer that is most likely the picture.

    The one without a name is preferred, then one named Combined, beauty, rgba or the like, then the first; colours
    before grey. Layers named as normals, depth, Cryptomatte and such are never taken.

    Raises:
        InputError: missing, damaged, of a size that such a file cannot hold, or without light in it.
    """
    with decoding(path, "an EXR picture", remedy), silence(), _PRINTING, redirect_stdout(io.StringIO()):
        parts = exr_parts(path, remedy, grouped=False)
        layers = [layer for part in parts for layer in _layers(part, alone=len(parts) == 1)]
        if not layers:
            names = [name if len(parts) == 1 else f"{part.name()}: {name}" for part in parts for name in part.channels]
            raise InputError(
                f"{path}: wants channels R, G, B, has {', '.join(sorted(names))[:80]}; save the colour alone"
            )
        chosen = min(layers, key=_rank)
        pixels = np.stack([_array(channel) for channel in chosen.channels], axis=-1)
        alpha = None if chosen.alpha is None else _array(chosen.alpha).astype(pixels.dtype)
        whole = alpha is None or alpha.shape == pixels.shape[:2]
        return ExrColours(
            _place(pixels, chosen.header),
            _place(alpha, chosen.header) if alpha is not None and whole else None,
            chosen.name,
        )


def _layers(part: Any, alone: bool) -> Iterator[_Layer]:
    """Yield the layers of a part that may be light."""
    groups: dict[str, dict[str, Any]] = {}
    for name, channel in part.channels.items():
        before, _, last = str(name).rpartition(".")
        groups.setdefault(before, {})[last.upper()] = channel
    for before, group in groups.items():
        full = ".".join(piece for piece in ("" if alone else part.name() or "", before) if piece)
        if _OTHERS.search(full):
            continue
        ways = (*_LIGHT, ("R",)) if group.keys() <= {"R", "A"} else _LIGHT
        names = next((names for names in ways if group.keys() >= set(names)), None)
        if names is not None:
            yield _Layer(full, tuple(group[name] for name in names), group.get("A"), part.header)


def _rank(layer: _Layer) -> tuple[int, int]:
    """Order layers, the wanted one first; Python's `min` keeps the file's order among equals."""
    pieces = re.split(r"[^a-z]+", layer.name.lower())
    named = next((place for place, wanted in enumerate(_PREFERRED) if wanted in pieces), len(_PREFERRED))
    return (len(layer.channels) == 1, 0 if not layer.name else 1 + named)


def _array(channel: Any) -> np.ndarray:  # (H, W) float16 or float32
    pixels = np.asarray(channel.pixels)
    return pixels if pixels.dtype.kind == "f" else pixels.astype(np.float32)


def _place(pixels: np.ndarray, header: dict[str, Any]) -> np.ndarray:
    """Put what the data window holds, (h, w, ...), into the display window; where they do not meet, it stays alone."""
    (left, top), (right, bottom) = (corner.astype(int) for corner in header["dataWindow"])
    (first_x, first_y), (last_x, last_y) = (corner.astype(int) for corner in header["displayWindow"])
    if (left, top, right, bottom) == (first_x, first_y, last_x, last_y):
        return np.ascontiguousarray(pixels)
    x0, x1, y0, y1 = max(left, first_x), min(right, last_x) + 1, max(top, first_y), min(bottom, last_y) + 1
    if x0 >= x1 or y0 >= y1:
        return np.ascontiguousarray(pixels)
    whole = np.zeros((last_y - first_y + 1, last_x - first_x + 1, *pixels.shape[2:]), pixels.dtype)
    whole[y0 - first_y : y1 - first_y, x0 - first_x : x1 - first_x] = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
    return whole
