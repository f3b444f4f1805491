"""Colour profiles: their curve is taken off, their primaries are named, and what is only about right is called so."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from profile_files import SRGB, curv, icc, para

from render.shared.errors import InputError
from render.shared.imaging.srgb import from_srgb
from sdps import photos
from sdps.photos.pictures.profiles import Profile, read_profile

CODES = np.tile(np.arange(256, dtype=np.uint8)[:, None, None], (1, 16, 3))
PLACES = np.linspace(0, 1, 1024)
L_STAR = np.where(PLACES <= 0.08, PLACES / 9.033, ((PLACES + 0.16) / 1.16) ** 3)


@pytest.mark.parametrize(
    ("curve", "space", "gamma", "words"),
    [
        (SRGB, "sRGB", "srgb", "taken as sRGB, because the files' colour profile says so"),
        (SRGB, "Display P3", "srgb", "says so; colours stay in its primaries (Display P3)"),
        (para(2.19921875), "Adobe RGB", 2.19921875, "raised to the power 2.2, because"),
        (curv(563), "Adobe RGB", 2.19921875, "colours stay in its primaries (Adobe RGB)"),
        (curv(), "Display P3", "linear", "taken as linear, because the files' colour profile says so; colours stay"),
        (para(1.0), "sRGB", "linear", "taken as linear"),
        (curv(*np.rint(65535 * from_srgb(PLACES)).astype(int)), "sRGB", "srgb", "taken as sRGB, because"),
        (curv(*np.rint(65535 * L_STAR).astype(int)), "sRGB", None, "taken as about raised to the power 2.4"),
    ],
)
def test_the_curve_of_the_profile_is_taken_off(
    tmp_path: Path, curve: bytes, space: str, gamma: str | float | None, words: str
) -> None:
    for number in range(3):
        Image.fromarray(CODES).save(tmp_path / f"{number}.png", icc_profile=icc(curve, space))
    Image.new("L", (16, 256), 255).save(tmp_path / "mask.png")
    read = photos.load(tmp_path)
    assert words in " | ".join(read.notes)
    if gamma is None:
        return
    assert read.gamma == pytest.approx(gamma, abs=1e-6) if isinstance(gamma, float) else read.gamma == gamma
    linear = {"srgb": from_srgb(PLACES[::4]), "linear": PLACES[::4]}.get(str(gamma))
    values = np.arange(256) / 255
    linear = from_srgb(values) if gamma == "srgb" else values if gamma == "linear" else values ** float(gamma)
    np.testing.assert_allclose(read[0:1][0, :, 0, 0], linear, atol=1e-6)


def test_one_picture_of_other_primaries_is_told(tmp_path: Path) -> None:
    for number, space in enumerate(("sRGB", "sRGB", "Display P3")):
        Image.fromarray(CODES).save(tmp_path / f"{number}.png", icc_profile=icc(SRGB, space))
    with pytest.raises(InputError, match=r"2.png: is 8-bit PNG with a profile of exponent 2.22 \(Displ"):
        photos.load(tmp_path)


def test_tables_in_place_of_curves_and_damage_say_nothing() -> None:
    whole = icc(SRGB)
    assert read_profile(whole.replace(b"rTRC", b"A2B0")) == Profile()
    assert read_profile(whole.replace(b"para", b"mluc")) == Profile()
    for length in range(0, len(whole), 7):
        read_profile(whole[:length])
    assert read_profile(icc(para(0.0))) == read_profile(icc(para(-1.0))) == Profile()
