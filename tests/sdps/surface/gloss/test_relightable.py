"""Relightable files, read by a few lines written after the formats' descriptions."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from render.shared.errors import InputError
from render.shared.imaging.srgb import to_srgb
from sdps.core.geometry import Capture, reach
from sdps.surface.gloss.pixel_lights import PixelLights
from sdps.surface.gloss.relightable import (
    expand_harmonics,
    expand_polynomial,
    fit_near_pictures,
    fit_pictures,
    measure_error,
    write_ptm,
    write_rti,
)

SIZE, COUNT = 48, 60
WIDE = SIZE + 8  # sides that differ


def read_ptm(path: Path, light: np.ndarray) -> np.ndarray:  # (H, W, 3) in 0 to 1
    *head, data = path.read_bytes().split(b"\n", 6)
    assert head[:2] == [b"PTM_1.2", b"PTM_FORMAT_LRGB"]
    width, height = int(head[2]), int(head[3])
    scale, bias = (np.array(line.split(), float) for line in head[4:6])
    assert len(data) == 9 * width * height
    numbers = np.frombuffer(data, np.uint8, 6 * width * height).reshape(height, width, 6)
    colour = np.frombuffer(data, np.uint8, offset=numbers.size).reshape(height, width, 3)
    u, v, _ = light
    level = ((numbers - bias) * scale) @ [u * u, v * v, u * v, u, v, 1.0]
    return np.clip(level[..., None] * colour / 255.0**2, 0.0, 1.0)[::-1]


def read_rti(path: Path, light: np.ndarray) -> np.ndarray:  # (H, W, 3) in 0 to 1
    magic, kind, sides, form, data = path.read_bytes().split(b"\n", 4)
    assert (magic, kind) == (b"#HSH1.2", b"3")
    width, height, channels = map(int, sides.split())
    terms, by_channel, size = map(int, form.split())
    assert (channels, by_channel, size) == (3, 2, 1)
    scale, bias = np.frombuffer(data, "<f4", 2 * terms).reshape(2, terms)
    numbers = np.frombuffer(data, np.uint8, offset=8 * terms).reshape(height, width, 3, terms) / 255.0
    return np.clip((numbers * scale + bias) @ expand_harmonics(light[None], terms)[0], 0.0, 1.0)


def lights_above(count: int) -> np.ndarray:  # (count, 3)
    turn, z = np.arange(count) * 2.4, np.linspace(0.98, 0.35, count)
    return np.stack([np.cos(turn) * np.sqrt(1 - z * z), np.sin(turn) * np.sqrt(1 - z * z), z], axis=1)


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mask, lights, and linear pictures (L, n, 3) of a matt ball, red on its left and green on its right."""
    y, x = np.mgrid[0:SIZE, 0:WIDE].astype(float)
    x, y = (x - WIDE / 2 + 0.5) / (SIZE / 2), (SIZE / 2 - 0.5 - y) / (SIZE / 2)
    mask = x * x + y * y < 0.9
    normals = np.stack([x, y, np.sqrt(np.clip(1 - x * x - y * y, 0, 1))], axis=-1)[mask]
    albedo = np.where(normals[:, :1] < 0.0, [0.8, 0.3, 0.2], [0.2, 0.7, 0.4])
    lights = lights_above(COUNT)
    return mask, lights, np.clip(normals @ lights.T, 0.0, None).T[..., None] * albedo


def worst(mask: np.ndarray, lights: np.ndarray, pictures: np.ndarray, read: object) -> float:
    errors = []
    for light, picture in zip(lights[::7], pictures[::7], strict=True):
        shown = read(light)
        assert shown.shape == (SIZE, WIDE, 3)
        assert shown[~mask].max() < 0.05
        errors.append(np.sqrt(((shown[mask] - to_srgb(picture)) ** 2).mean()))
    return max(errors)


def test_a_ptm_shows_the_photographs(ball: tuple, tmp_path: Path) -> None:
    mask, lights, pictures = ball
    write_ptm(tmp_path / "a.ptm", fit_pictures(pictures, expand_polynomial(lights)), mask)
    assert worst(mask, lights, pictures, lambda light: read_ptm(tmp_path / "a.ptm", light)) < 0.07


@pytest.mark.parametrize(("terms", "most"), [(4, 0.09), (9, 0.06)])
def test_an_rti_shows_the_photographs(ball: tuple, tmp_path: Path, terms: int, most: float) -> None:
    mask, lights, pictures = ball
    write_rti(tmp_path / "a.rti", fit_pictures(pictures, expand_harmonics(lights, terms)), mask)
    assert worst(mask, lights, pictures, lambda light: read_rti(tmp_path / "a.rti", light)) < most


@pytest.fixture
def near(ball: tuple) -> tuple[list[np.ndarray], PixelLights]:
    """The ball's pictures under lamps one and a half of its diameters away, and these lamps."""
    mask, directions, pictures = ball
    z = np.zeros(mask.shape)
    rows, columns = np.nonzero(mask)
    x, y = (columns - WIDE / 2 + 0.5) / (SIZE / 2), (SIZE / 2 - 0.5 - rows) / (SIZE / 2)
    normals = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    z[mask] = SIZE / 2 * (normals[:, 2] - normals[:, 2].mean())
    nearness = np.full(COUNT, 1 / 3)
    lights = PixelLights.of(Capture.of(mask), mask, z, directions, nearness)
    towards, falloff = reach(lights.capture.places(z)[mask], directions, nearness)
    albedo = pictures.max(axis=0)
    lit = np.clip((normals[:, None] * towards).sum(-1), 0.0, None) * falloff
    return list(lit.T[..., None] * albedo), lights


@pytest.mark.parametrize("kind", ["ptm", "rti"])
def test_pictures_under_near_lamps_are_relit_as_from_afar(ball: tuple, near: tuple, tmp_path: Path, kind: str) -> None:
    mask, directions, pictures = ball
    photographs, lights = near
    expand = expand_polynomial if kind == "ptm" else partial(expand_harmonics, terms=9)
    write, read = (write_ptm, read_ptm) if kind == "ptm" else (write_rti, read_rti)
    evened = [lights.even_out(picture, number) for number, picture in enumerate(photographs)]
    numbers = fit_near_pictures(lambda: evened, expand, lights)
    write(tmp_path / "own", numbers, mask)
    write(tmp_path / "alike", fit_pictures(photographs, expand(directions)), mask)
    own, alike = (
        worst(mask, directions, pictures, lambda light, name=name: read(tmp_path / name, light))
        for name in ("own", "alike")
    )
    assert own < 0.075
    assert alike > 1.8 * own
    assert measure_error(evened, expand(directions), numbers, expand, lights) < 0.06


def test_too_few_lights_are_refused() -> None:
    with pytest.raises(InputError, match="of 6 numbers a pixel needs 6 lights or more, got 5"):
        fit_pictures([np.ones((3, 3))] * 5, expand_polynomial(lights_above(5)))
