"""The corpus of folders: kinds and depths of pictures, rotated ones, and colour profiles. One row is one folder."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from folder_corpus import COUNT, OUTLINE, SHOTS, SIZE, Row, codes, save, save_16, shots, single, try_row
from PIL import Image, ImageCms, features
from raw_files import dng, mosaic

from sdps.photos.picture_file import orient_pixels

PHONE = Path(__file__).parent.parent / "sdps/photos/pictures/decoding"
TURNED = (SIZE[1], SIZE[0])
LINEAR = {"gamma": "linear"}


def tiff(path: Path, image: np.ndarray, kind: str = "u1", **how: object) -> None:
    """Write a TIFF of a type of numbers; integers over their whole range."""
    most = np.iinfo(kind).max if np.dtype(kind).kind in "iu" else 1
    values = (np.clip(image, 0, 1) * most).astype(kind)
    if how.get("planarconfig") == "separate":
        values = np.moveaxis(values, -1, 0)
    tifffile.imwrite(path, values, **({"photometric": "rgb"} | how))


def inks(path: Path, image: np.ndarray, bits: int = 8) -> None:
    """Write a CMYK TIFF without black."""
    colours = codes(1 - image, bits)
    tifffile.imwrite(path, np.dstack([colours, np.zeros_like(colours[..., :1])]), photometric="separated")


def exr(path: Path, image: np.ndarray, broken: bool = False) -> None:
    import OpenEXR

    values = np.ascontiguousarray(image, np.float32)
    if broken:
        values[14:18, 18:22] = np.nan
    OpenEXR.File({}, {"RGB": values}).write(str(path))


def raw_file(path: Path, image: np.ndarray, tag: int = 1) -> None:
    path.write_bytes(dng(mosaic(codes(image, 16)), orientation=tag))


def turned(path: Path, image: np.ndarray, tag: int, tagged: bool = True) -> None:
    """Write a picture that was upright as a sensor saw it that was turned, with or without a tag that says so."""
    back = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}[tag]
    save(path, orient_pixels(image, back), tag=tag if tagged else 0)


def phone(*names: str):
    """Return what copies pictures of the phone in tests/sdps/photos/pictures."""

    def build(folder: Path) -> None:
        for number, name in enumerate(names):
            (folder / f"IMG_{number}.HEIC").write_bytes((PHONE / f"{name}.heic").read_bytes())
        save(folder / "mask.png", np.pad(np.ones((20, 30)), ((6, 6), (9, 9))), "L")

    return build


def profile(name: str) -> dict[str, bytes]:
    return {"icc_profile": ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()}


def mixed(*builds: tuple[str, object, dict[str, object]]):
    """Return what writes one picture of each (name, writer, options)."""

    def build(folder: Path) -> None:
        for (name, write, how), image in zip(builds, SHOTS, strict=False):
            write(folder / name, image, **how)

    return build


SIX = {"gamma": "linear", "bits": 16, "exact": 1e-4}
ROWS = [
    # ---- Kinds and depths ----
    Row("PNG of 8 bits", (shots(),)),
    Row("PNG of 8 bits taken as linear", (shots(),), options=LINEAR, gamma="linear", exact=3e-3),
    Row("PNG of 16 bits", (shots(write=save_16),), **SIX),
    Row("grey PNG of 8 bits", (shots(mode="L"),)),
    Row("grey PNG of 16 bits", (lambda f: [save_16(f / f"{k}.png", SHOTS[k][..., 0]) for k in range(6)],),
        gamma="linear", bits=16),
    Row("PNG with a palette", (shots(mode="P"),)),
    Row("PNG of two values", (shots(mode="1"),)),
    Row("JPEG of a camera", (shots("DSC{:05}.JPG"),), notes=("values are taken as sRGB",)),
    Row("grey JPEG", (shots("a{}.jpg", mode="L"),)),
    Row("CMYK JPEG", (shots("a{}.jpg", mode="CMYK"),)),
    Row("progressive JPEG", (shots("a{}.jpeg", progressive=True),)),
    Row("MPO of a camera with two lenses", (shots("DSC{}.MPO", kind="MPO", save_all=True),)),
    Row("BMP", (shots("{}.bmp"),)),
    Row("TGA of a class set", (shots("{}.tga"),)),
    Row("PPM", (shots("{}.ppm"),)),
    Row("PGM of 16 bits", (lambda f: [save_16(f / f"{k}.pgm", SHOTS[k][..., 0]) for k in range(6)],),
        gamma="linear", bits=16),
    Row("WebP", (shots("{}.webp", lossless=True),)),
    Row("TIFF of 8 bits", (shots("{}.tif", write=tiff),)),
    Row("TIFF of 16 bits", (shots("{}.tiff", write=tiff, kind="u2"),), **SIX),
    Row("TIFF of 16 bits, LZW", (shots("{}.tif", write=save_16),), **SIX),
    Row("TIFF of 16 bits, channels one after another",
        (shots("{}.tif", write=tiff, kind="u2", planarconfig="separate"),), **SIX),
    Row("TIFF of 32-bit integers", (shots("{}.tif", write=tiff, kind="u4"),), gamma="linear", bits=32, exact=1e-5),
    Row("TIFF of 16-bit integers with a sign", (shots("{}.tif", write=tiff, kind="i2"),), gamma="linear", bits=16,
        exact=1e-4),
    Row("TIFF of floats", (shots("{}.tif", write=tiff, kind="f4"),), gamma="linear", bits=32, exact=1e-6),
    Row("TIFF of half floats", (shots("{}.tif", write=tiff, kind="f2"),), gamma="linear", bits=16, exact=1e-3),
    Row("TIFF of double floats", (shots("{}.tif", write=tiff, kind="f8"),), gamma="linear", bits=32, exact=1e-6),
    Row("TIFF of 8-bit integers with a sign", (shots("{}.tif", write=tiff, kind="i1"),),
        error="1.tif: pixels are int8"),
    Row("CMYK TIFF of 8 bits", (shots("{}.tif", write=inks),)),
    Row("CMYK TIFF of 16 bits", (shots("{}.tif", write=inks, bits=16),),
        error="1.tif: its colours are inks (CMYK); save it as RGB or grey"),
    Row("EXR", (shots("{}.exr", write=exr),), gamma="linear", bits=32, exact=1e-6),
    Row("EXR with values that are no numbers", (shots("{}.exr", write=exr, broken=True),),
        error="NaN or infinite values inside the mask"),
    Row("camera RAW", (shots("DSC_{:04}.DNG", write=raw_file),), notes=("camera RAW is developed linearly",),
        gamma="linear", bits=16),
    Row("HEIC of a phone", (phone("upright", "upright", "upright"),), files=3, mask="file", shape=(32, 48),
        options={"anyway": True}),
    Row("half PNG, half JPEG", (shots(count=3), shots("b{}.jpg", count=3)), error="keep one kind in the folder"),
    Row("8 and 16 bits", (shots(count=4), single("z.png", SHOTS[5], save_16)), error="z.png: is 16-bit PNG"),
    # ---- Rotated ----
    Row("a phone held upright", (shots("IMG_{}.jpg", write=turned, tag=6),),
        notes=("all pictures were turned upright",)),
    Row("a phone held upside down", (shots("IMG_{}.jpg", write=turned, tag=3),), notes=("turned upright",)),
    Row("a selfie, mirrored", (shots("IMG_{}.jpg", write=turned, tag=2),), notes=("turned upright",)),
    Row("mirrored and turned", (shots("IMG_{}.jpg", write=turned, tag=7),), notes=("turned upright",)),
    Row("a turned PNG", (shots("{}.png", write=turned, tag=8),), notes=("turned upright",), options=LINEAR,
        gamma="linear", exact=3e-3),
    Row("a turned TIFF", (shots("{}.tif", write=turned, tag=8),), notes=("turned upright",), options=LINEAR,
        gamma="linear", exact=3e-3),
    Row("turned RAW", (shots("{}.dng", write=raw_file, tag=6),), notes=("turned upright",), gamma="linear", bits=16,
        shape=TURNED),
    Row("one tag is another, as the camera looked down", (
        mixed(*((f"{k}.jpg", save, {"tag": 6 if k == 3 else 1}) for k in range(6))),
    ), notes=("the orientation tags of 3.jpg differ from the first picture's",)),
    Row("one was saved turned by another program", (
        mixed(*((f"{k}.png", turned, {"tag": 6 if k != 4 else 1}) for k in range(6))),
    ), notes=("4.png was saved turned", "turned to agree"), options=LINEAR, gamma="linear", exact=3e-3),
    Row("one lies on its side without a tag", (
        shots(count=5), lambda f: turned(f / "IMG_9.png", SHOTS[5], 6, tagged=False),
    ), error="IMG_9.png: is 32x40 pixels, the other 5 (as IMG_0001.png) are 40x32; all pictures must have one size (it "
        "is turned by 90 degrees, turn it back)"),
    Row("a phone turned while it took HEIC", (phone("upright", "turned", "upright"),), files=3, mask="file",
        shape=(32, 48), options={"anyway": True}, notes=("the orientation tags of IMG_1.HEIC differ",)),
    # ---- Colour profiles ----
    Row("JPEG with the profile of sRGB", (shots("{}.jpg", **profile("sRGB")),),
        notes=("values are taken as sRGB, because the files' colour profile says so",)),
    Row("16 bits with the profile of sRGB", (
        shots("{}.tif", write=tiff, kind="u2", iccprofile=profile("sRGB")["icc_profile"]),
    ), bits=16, notes=("values are taken as sRGB, because the files' colour profile",)),
    Row("one of another profile", (shots("{}.jpg", count=5), single("z.jpg", SHOTS[5], **profile("sRGB"))),
        error="z.jpg: is 8-bit JPEG with a profile of exponent 2.22, the other 5 (as 1.jpg) are 8-bit JPEG"),
    Row("a profile that is nonsense", (shots("{}.png", icc_profile=b"nonsense" * 30),)),
]  # fmt: skip
if features.check("avif"):
    ROWS.append(Row("AVIF of a phone", (shots("{}.avif"),)))


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_folder(row: Row, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    try_row(row, tmp_path, capfd)


def test_the_sphere_is_seen() -> None:
    assert 0.3 < OUTLINE.mean() < 0.5 and SHOTS.max() < 1 and len(SHOTS) > COUNT
    assert Image.fromarray(codes(SHOTS[0])).size == SIZE[::-1]
