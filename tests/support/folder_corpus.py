"""A corpus of folders as people have them: a Lambertian sphere of 32 x 40 pixels, written in every way.

A `Row` says how a folder is made and what is expected of it: what is read, which notes are told, or which one-line
error ends the command with exit code 2. Tables of rows are in tests/photo_folders; one row is one folder.
"""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from render.shared.errors import InputError
from sdps import photos

SIZE = (32, 40)
DIRECTIONS = np.array([[0.5, 0, 0.8], [-0.5, 0, 0.8], [0, 0.5, 0.8], [0, -0.5, 0.8], [0.3, 0.3, 0.9], [-0.3, 0.3, 0.9],
                       [0.3, -0.3, 0.9], [-0.3, -0.3, 0.9], [0.6, 0.1, 0.75], [-0.6, -0.1, 0.75]])  # fmt: skip
LIGHTS = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
COUNT = 6
_LEAST = 0.01


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return normals (H, W, 3), 0 outside, and the outline."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    x, y = (columns - 19.5) / 13, (15.5 - rows) / 13
    squared = 1 - x**2 - y**2
    inside = squared > 0.02
    return np.where(inside[..., None], np.stack([x, y, np.sqrt(np.maximum(squared, 0))], axis=-1), 0), inside


NORMALS, OUTLINE = _sphere()


def shade(light: np.ndarray) -> np.ndarray:
    """Return a photograph (H, W, 3), linear values up to 0.82, with a little noise that is always the same."""
    shading = np.maximum(NORMALS @ light, 0)[..., None] * np.array([0.8, 0.7, 0.6])
    noise = np.random.default_rng(int(1e6 * abs(light[0] + 2 * light[1]))).uniform(0, 0.004, (*SIZE, 3))
    return shading + _LEAST + noise


SHOTS = np.stack([shade(light) for light in LIGHTS])
ROOM = np.full((*SIZE, 3), 0.08) + 0.04 * OUTLINE[..., None]


def codes(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Return values as 8-bit or 16-bit integers."""
    return np.rint(np.clip(image, 0, 1) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def save(path: Path, image: np.ndarray, mode: str = "RGB", tag: int = 0, kind: str | None = None, **how: Any) -> None:
    """Write 8 bits by Pillow in a mode, with an orientation tag; `kind` if the suffix is not to decide."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(codes(image)).convert(mode)
    exif = Image.Exif()
    if tag:
        exif[274] = tag
        how["exif"] = exif
    if path.suffix.lower() in (".jpg", ".jpeg", ".heic", ".avif") or kind in ("JPEG", "AVIF"):
        how.setdefault("quality", 95)
    file = io.BytesIO()
    picture.save(file, kind or Image.registered_extensions()[path.suffix.lower()], **how)
    path.write_bytes(file.getvalue())


def save_16(path: Path, image: np.ndarray) -> None:
    """Write 16 bits by OpenCV, grey where the image is (H, W)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = codes(image, 16)
    data = cv2.imencode(path.suffix, values if values.ndim == 2 else np.ascontiguousarray(values[..., ::-1]))[1]
    path.write_bytes(data.tobytes())


Build = Callable[[Path], None]


def shots(name: str = "IMG_{:04}.png", count: int = COUNT, write: Callable[..., None] = save, **how: Any) -> Build:
    """Return what writes `count` photographs, numbered from 1."""

    def build(folder: Path) -> None:
        for number in range(count):
            write(folder / name.format(number + 1), SHOTS[number], **how)

    return build


def single(name: str, image: np.ndarray, write: Callable[..., None] = save, **how: Any) -> Build:
    """Return what writes one picture."""
    return lambda folder: write(folder / name, image, **how)


def text(name: str, *lines: str) -> Build:
    """Return what writes lines of text."""

    def build(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")

    return build


def raw(name: str, data: bytes) -> Build:
    """Return what writes bytes."""

    def build(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)

    return build


@dataclass(frozen=True)
class Row:
    """One folder and what is expected of it.

    Attributes:
        name: What it shows.
        parts: What writes it, in this order.
        files: How many photographs are read, or their names.
        notes: Parts of notes that must be told.
        quiet: What no note may contain.
        error: Part of the one line, with which the command ends; empty where the folder is read.
        options: Of `load`, as of the command; in texts `{}` stands for the folder.
        mask: Where the mask is from.
        gamma: The curve that is taken off.
        bits: Of the files.
        shape: Of the pictures as read.
        lit: Lights were read, and are right.
        exact: Greatest difference of the values, as read, from the linear ones; None where they are not compared.
    """

    name: str
    parts: tuple[Build, ...]
    files: int | tuple[str, ...] = COUNT
    notes: tuple[str, ...] = ()
    quiet: str = ""
    error: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    mask: str = "automatic"
    gamma: str | float = "srgb"
    bits: int = 8
    shape: tuple[int, int] = SIZE
    lit: bool = False
    exact: float | None = None


def try_row(row: Row, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Write the folder, read it and check it; or run the command that must end with one line."""
    folder = place / "photos of the day"
    folder.mkdir()
    for part in row.parts:
        part(folder)
    options = {key: value.format(folder) if isinstance(value, str) else value for key, value in row.options.items()}
    if row.error:
        with pytest.raises(InputError) as error:
            photos.load(folder, **options)
        assert row.error in str(error.value)
        flags = [word for key, value in options.items() for word in _flag(key, value)]
        assert main(["infer", str(folder), "--out", str(place / "out"), *flags]) == 2
        said = capfd.readouterr()
        assert str(error.value) in said.err and said.err.count("\n") == 1, said
        assert said.out.count("\n") <= 1, said  # the folder it looks at
        return
    read = photos.load(folder, **options)
    told = " | ".join(read.notes)
    for note in row.notes:
        assert note in told, told
    assert not row.quiet or row.quiet not in told, told
    assert read.files == row.files if isinstance(row.files, tuple) else len(read) == row.files, (read.files, told)
    assert (read.mask_origin, read.gamma, read.bits, read.shape) == (row.mask, row.gamma, row.bits, row.shape), told
    assert (read.light_directions is not None) == row.lit
    if row.lit:
        np.testing.assert_allclose(read.light_directions, LIGHTS[: len(read)], atol=1e-3)
    if row.exact is not None:
        np.testing.assert_allclose(read[0 : len(read)], SHOTS[: len(read)], atol=row.exact)
    photos.check(read)
    assert capfd.readouterr() == ("", ""), "a decoder printed something"


def _flag(key: str, value: Any) -> list[str]:
    """Return an option of `load` as the command's flag."""
    if key == "names":
        return [word for name in value for word in ("--images", name)]
    return [f"--{key.replace('_', '-')}", *([] if value is True else [str(value)])]
