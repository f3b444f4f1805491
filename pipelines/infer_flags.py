"""The flags of `sdps infer`."""

import argparse
from pathlib import Path

from pipelines.export_result import add_normals
from pipelines.shared import network_flags

AUTO = "auto"
"""A scale that keeps time and memory in bounds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps infer`."""
    _add_input(parser)
    _add_method(parser)
    network_flags.add_arguments(parser)
    parser.add_argument("--dry-run", action="store_true",
                        help="say what was understood and what would be done, and write nothing")  # fmt: skip
    parser.add_argument("--self-test", action="store_true",
                        help="render a bunny, save it as photographs, and compare with the truth")  # fmt: skip


def _add_input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, nargs="?", 
                        help="photographs of a static object under moving light: a folder, one of Meshroom's poses "
                        "(ps_*) or of .data folders, a ZIP of these, or a film")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("out/infer"), help="output folder")
    parser.add_argument("--method", default="auto", metavar="NAME",
                        help="any model or classical method: sdps, lcnet+psfcn, pf14, ... (default: auto)")  # fmt: skip
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--mask", default=None, help="picture, bright on the object (default: mask.*, else automatic)")
    parser.add_argument("--lights", default=None, metavar="FILE|folder",
                        help="known light directions: rows x y z, .lp, .csv, .npy, .npz, .mat, lights.json, JSON of "
                        "Meshroom or RelightLab, HALCON's slants.tup; folder: the file of lights among the "
                        "photographs")  # fmt: skip
    parser.add_argument("--ball", action="append", default=None, metavar="X,Y,R|auto|FOLDER",
                        help="a chrome or white ball that shows the lights, in place of --lights: its circle in "
                        "pixels of the files, auto to find it, or a folder of pictures of it alone, FOLDER or "
                        "FOLDER:x,y,r; chrome: or white: before it says its kind; two balls give positions "
                        "(repeatable)")  # fmt: skip
    parser.add_argument("--ball-radius", default=None, metavar="MM[,MM]",
                        help="real radius of the balls, or of each in turn: gives the size of a pixel and, with "
                        "--focal, how far from the camera each stands")  # fmt: skip
    parser.add_argument("--intensities", default=None, metavar="FILE|folder|equal",
                        help="known light intensities; equal if all lights are alike (default: those of --lights, else "
                        "found by a network)")  # fmt: skip
    parser.add_argument(
        "--frame", default="y-up", help="axes of the lights file: y-up, y-down, x-left, z-away, xy-swapped"
    )
    parser.add_argument("--light-distance", default="auto", metavar="D",
                        help="far, a number of object sizes, 400mm (with --pixel-size), or each: not the same for all "
                        "lamps (default: by --lights, else not known)")  # fmt: skip
    parser.add_argument("--gamma", default="auto", help="linear, srgb, or an exponent (default: by kind of file)")
    parser.add_argument("--images", action="append", default=None, metavar="PATTERN",
                        help="files to use, in this order; one that begins with ! leaves files out")  # fmt: skip
    parser.add_argument("--ambient", default=None, metavar="FILE",
                        help="picture with the lamp off, subtracted; none for none (default: *ambient*)")  # fmt: skip
    parser.add_argument("--dark", default=None, metavar="FILE",
                        help="picture with the lens covered, subtracted; none for none (default: *dark*)")  # fmt: skip
    parser.add_argument("--every", type=int, default=None, metavar="N",
                        help="of a film, look at every N-th frame (default: so that about 60 are)")  # fmt: skip


def _add_method(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--discontinuities", action="store_true", help="let the depth jump where slopes disagree")
    parser.add_argument("--refine", action=argparse.BooleanOptionalAction, default=None,
                        help="refine normals and lights until a simple model explains the photographs, and join that "
                        "with what the network says (default: where a network finds the normals)")  # fmt: skip
    parser.add_argument("--lit-by", choices=(AUTO, "lamp", "any"), default=AUTO,
                        help="one lamp at a time in a dark room, or any light: a room, a window, several lamps "
                        "(default: auto, by how the photographs look)")  # fmt: skip
    parser.add_argument("--anyway", action="store_true",
                        help="go on where a check of the photographs stops (the report says which)")  # fmt: skip
    parser.add_argument("--scale", type=_read_scale, default=1.0, metavar="F|auto",
                        help="reduce pictures and mask as they are read; 0.5 halves the sides; auto: so that it takes "
                        "under ten minutes and 4 GiB")  # fmt: skip
    parser.add_argument("--focal", default=None, metavar="28mm|3772px",
                        help="focal length: 35 mm equivalent, or pixels of the files; orthographic for none "
                        "(default: as the files' EXIF data say, else orthographic)")  # fmt: skip
    parser.add_argument("--principal", default=None, metavar="COLUMN,ROW",
                        help="principal point, in pixels of the files (default: their middle)")  # fmt: skip
    parser.add_argument("--pixel-size", type=float, default=None, metavar="MM",
                        help="millimetres that a pixel of the files shows: the unit of depth and meshes")  # fmt: skip
    parser.add_argument("--export", default=None, metavar="NAME[,NAME]",
                        help="also write files for other programs, into exports (see `sdps export`)")  # fmt: skip
    add_normals(parser)
    parser.add_argument("--flat", nargs="?", const="yes", default=AUTO, metavar="yes|no|turned",
                        help="a coin, relief, textile or painting that faces the camera, the whole frame without a mask"
                        "; turned: what stands out came out hollow (default: auto, by how it looks)")  # fmt: skip
    parser.add_argument("--flatten", nargs="?", type=_read_share, const=0.25, default=0.0, metavar="SHARE",
                        help="of a flat thing, take off the mean slope of this share of the width around every pixel "
                        "(0.25 without a number; default: none)")  # fmt: skip


def _read_share(text: str) -> float:
    """Return a share of the width.

    Raises:
        ArgumentTypeError: not a number, such as the folder, which argparse gives to a flag that stands before it.
    """
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number; name the folder before --flatten") from None


def _read_scale(text: str) -> float | str:
    """Return a scale, or `auto`; anything else is refused by argparse."""
    return text if text == AUTO else float(text)
