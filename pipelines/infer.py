"""`sdps infer`: a folder of photographs under moving light in, normals, lights, depth, meshes and a page out."""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.evaluate.report import page as report
from pipelines.evaluate.report.sections import Section, SectionWriter, Table, Tile
from pipelines.shared import dry_run, network_flags, pictures
from render.shared.errors import InputError
from render.shared.progress import bars, stage
from sdps.core.intensities import grey, scale_to_mean

if TYPE_CHECKING:
    from sdps.api import Inference
    from sdps.photos import Finding, Photographs
    from sdps.refinement.trust import RefinedEstimate

AUTO = "auto"
"""A scale that keeps time and memory in bounds."""
_MARKS = {"error": "!!", "warning": "! ", "note": "- "}
_MOST_LISTED = 6
_MOST_SIDE = 700  # of the object, in pixels: twice that and more is thinned for the page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps infer`."""
    parser.add_argument("folder", type=Path, nargs="?", help="photographs of a static object under moving light")
    parser.add_argument("--out", type=Path, default=Path("out/infer"), help="output folder")
    parser.add_argument("--method", default="auto", metavar="NAME",
                        help="any model or classical method: sdps, lcnet+psfcn, pf14, ... (default: auto)")  # fmt: skip
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")
    parser.add_argument("--mask", default=None, help="picture, bright on the object (default: mask.*, else automatic)")
    parser.add_argument("--lights", default=None, metavar="FILE|folder",
                        help="known light directions: rows x y z, .lp, .csv, .npy, .npz, .mat, lights.json, JSON of "
                        "Meshroom or RelightLab; folder: the file of lights among the photographs")  # fmt: skip
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
    parser.add_argument("--discontinuities", action="store_true", help="let the depth jump where slopes disagree")
    parser.add_argument("--refine", action=argparse.BooleanOptionalAction, default=None,
                        help="refine normals and lights until a simple model explains the photographs, and join that "
                        "with what the network says (default: where a network finds the normals)")  # fmt: skip
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
    parser.add_argument("--flat", nargs="?", const="yes", default=AUTO, metavar="yes|no|turned",
                        help="a coin, relief, textile or painting that faces the camera, the whole frame without a mask"
                        "; turned: what stands out came out hollow (default: auto, by how it looks)")  # fmt: skip
    parser.add_argument("--flatten", nargs="?", type=_read_share, const=0.25, default=0.0, metavar="SHARE",
                        help="of a flat thing, take off the mean slope of this share of the width around every pixel "
                        "(0.25 without a number; default: none)")  # fmt: skip
    network_flags.add_arguments(parser)
    parser.add_argument("--dry-run", action="store_true",
                        help="say what was understood and what would be done, and write nothing")  # fmt: skip
    parser.add_argument("--self-test", action="store_true",
                        help="render a bunny, save it as photographs, and compare with the truth")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Check the photographs, run the method, write the results; with `--self-test` on photographs made for it."""
    if args.self_test:
        from pipelines.evaluate.self_test import photograph_bunny

        args.folder = photograph_bunny(args.out / "photographs")
    if args.folder is None and Path(args.flat).is_dir():  # `--flat photographs`: a folder is no wish
        args.folder, args.flat = Path(args.flat), "yes"
    if args.folder is None:
        raise InputError("name a folder of photographs, or use --self-test")
    with bars(without=("reading", "checks", "refinement")):  # these have their own
        if args.dry_run:
            return rehearse(args)
        result, said = infer_folder(args)
        made = result.save(args.out)
        page = write_page(args.out / "report.html", result)
    if args.self_test:
        from pipelines.evaluate.self_test import compare

        sys.stdout.write(compare(args.folder, result, args.out))
    sys.stdout.write(describe(result.findings[said:]))
    sys.stdout.write(f"{_tell_lamps(result)}\n")
    sys.stdout.write(f"{result.method}: {result.seconds:.1f} s; {', '.join(path.name for path in made)}\n{page}\n")
    if result.verdict:
        sys.stdout.write(f"{_MARKS['error']} {result.verdict}\n")
    return 0


def infer_folder(args: argparse.Namespace) -> tuple["Inference", int]:
    """Read the photographs, say what was found about them, and run the method; also return how many were said."""
    from sdps.api import infer, plan

    photos, findings, options = look_through(args)
    if args.anyway or not any(finding.level == "error" for finding in findings):
        sys.stdout.write(f"{plan(photos, args.method, **options).describe()}\n")
        sys.stdout.flush()
    more = {"findings": findings, "anyway": args.anyway, "flat": args.flat, "flatten": args.flatten}
    return infer(photos, args.method, **options, **more), len(findings)


def rehearse(args: argparse.Namespace) -> int:
    """Say what was understood of the photographs and what `infer_folder` would do; write nothing.

    Raises:
        InputError: what would stop it.
    """
    from sdps.api import ask_about_lights, plan, stop

    photos, findings, options = look_through(args)
    sys.stdout.write(dry_run.describe_input(photos))
    expected = plan(photos, args.method, **options)
    sys.stdout.write(f"{expected.describe()}\n{dry_run.describe_work(expected, args.out)}")
    sys.stdout.flush()
    stop(photos, findings, args.anyway)
    if not args.anyway:
        expected.check()
    if photos.light_directions is not None:
        _, more = ask_about_lights(photos, args.models, options["config"])
        sys.stdout.write(describe(more))
        stop(photos, more, args.anyway)
    sys.stdout.write("nothing was written (--dry-run)\n")
    return 0


def look_through(args: argparse.Namespace) -> tuple["Photographs", "tuple[Finding, ...]", dict[str, Any]]:
    """Read the photographs and say what was found about them; also return findings, and options as of `sdps.infer`."""
    from sdps.api import check_out, load, plan
    from sdps.inference.inference_config import inference_config
    from sdps.methods.flat_things import Flatness
    from sdps.photos import check

    options = {"models": args.models, "config": inference_config(args), "refine": args.refine,
               "discontinuities": args.discontinuities}  # fmt: skip
    flat = Flatness(args.flat, args.flatten)
    check_out(args.out, args.folder)

    def read(scale: float) -> "Photographs":
        return load(
            args.folder, mask=args.mask, lights=args.lights, intensities=args.intensities, frame=args.frame,
            gamma=args.gamma, names=args.images, anyway=args.anyway, scale=scale, focal=args.focal,
            principal=args.principal, pixel_size=args.pixel_size, light_distance=args.light_distance,
            whole_frame=flat.asked,
        )  # fmt: skip

    photos = read(1.0 if args.scale == AUTO else args.scale)
    if args.scale == AUTO and (quick := plan(photos, args.method, **options).quick) is not None:
        sys.stdout.write(f"- reduced by --scale {quick[0]:g}, so that it takes less time and memory\n")
        photos = read(quick[0])
    findings = tuple(check(photos))
    height, width = photos.shape
    sys.stdout.write(f"{len(photos)} photographs of {width}x{height}; the camera is {_name_camera(photos)}\n")
    sys.stdout.write("".join(f"- {note}\n" for note in photos.notes) + describe(findings))
    return photos, findings, options


def _read_share(text: str) -> float:
    """Return a share of the width.

    Raises:
        ArgumentTypeError: no number, such as the folder, which argparse gives to a flag before it.
    """
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number; name the folder before --flatten") from None


def _read_scale(text: str) -> float | str:
    """Return a scale, or `auto`; what is no number is refused as argparse does."""
    return text if text == AUTO else float(text)


def describe(findings: "Sequence[Finding]") -> str:
    """Write the findings, one a line, the gravest first."""
    return "".join(f"{_MARKS[finding.level]}{finding.text}{_list_images(finding.images)}\n" for finding in findings)


def _name_camera(photos: "Photographs") -> str:
    return photos.camera_summary if photos.camera.is_perspective else "taken for orthographic"


def _tell_lamps(result: "Inference") -> str:
    """Return the sentence that says how far away the lamps stood."""
    text: str = result.lamps["text"]
    return f"{text[0].upper()}{text[1:]}."


def _list_images(images: Sequence[str]) -> str:
    if not images:
        return ""
    more = f", and {len(images) - _MOST_LISTED} more" if len(images) > _MOST_LISTED else ""
    return f" ({', '.join(images[:_MOST_LISTED])}{more})"


def write_page(path: Path, result: "Inference") -> Path:
    """Write the self-contained page of an inference."""
    stage("page")
    with tempfile.TemporaryDirectory() as temporary:
        writer = _section(result)
        stage("page", 1, 3)
        writer.write(Path(temporary))
        stage("page", 2, 3)
        report.render(path, [Path(temporary)], f"Photometric stereo: {result.photos.folder.resolve().name}", "")
    return path


def _section(result: "Inference") -> SectionWriter:
    """Return everything the page shows."""
    from sdps.surface.inferred import RELIT
    from sdps.surface.views import strip

    photos, mask = result.photos, result.photos.mask
    text = (
        f"{len(photos)} photographs of {photos.shape[1]}x{photos.shape[0]} pixels, {photos.bits} bits, gamma "
        f"{photos.gamma}; mask: {photos.mask_origin}, {int(mask.sum())} pixels. Method: {result.method}. Frame: "
        f"x right, y up, z to the camera; lights from the surface to the light. The camera is {_name_camera(photos)}. "
        f"{_tell_lamps(result)}"
    )
    section = Section(
        name="photographs",
        title="What was found",
        alert=result.verdict,
        text=text,
        tables=_tables(result),
        pictures_first=True,
    )
    writer, box = SectionWriter(section), _box(mask)
    lit = photos.window(_brightest(result), *box)[0]
    shown = pictures.tone_map(lit, pictures.auto_exposure(lit[None], mask[box]))
    tiles = [
        Tile("a photograph", shown),
        Tile(f"mask ({photos.mask_origin})", _tint_outside(shown, mask[box])),
        Tile("normals", pictures.normal_map(result.normals[box], mask[box]), "normals"),
        Tile("depth, near is bright", depth_picture(result, box)),
    ]
    if len(result.light_directions):
        tiles.append(Tile("lights, seen from the camera", pictures.light_plot(result.light_directions, result.gains)))
    writer.strip("Photograph, mask, normals, depth, lights", tiles)
    writer.strip("The surface from the left, the front and the right", [("", strip(result.depth, 360))], wide=True)
    relit = [(name.replace("-", " "), pictures.tone_map(result.relit_view(name, box))) for name in RELIT]
    writer.strip("Under lights of our choice (matt, with cast shadows)", relit)
    if result.refinement is not None:
        assert result.expected_error is not None  # refinement tells its own
        tiles = _refinement_pictures(result.refinement, result.expected_error[box], box, mask[box])
        writer.strip("Refinement", tiles)
    elif result.expected_error is not None:
        writer.strip("How sure the network is", [_draw_expected_errors(result.expected_error[box], mask[box])])
    return writer


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the object, with a little room around it; every n-th where they are very many."""
    found = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
    side = max(int(np.ptp(places)) for places in found)
    room, every = round(0.06 * side) + 1, max(1, side // _MOST_SIDE)
    rows, columns = (slice(max(places.min() - room, 0), places.max() + room + 1, every) for places in found)
    return rows, columns


def _refinement_pictures(
    found: "RefinedEstimate", expected: np.ndarray, box: tuple[slice, slice], mask: np.ndarray
) -> list[Tile]:
    """Return the normals before and refined, how far they moved, the error to expect of the answer, and what the model
    did not explain.
    """
    from sdps.core.metrics import angle_degrees

    moved = angle_degrees(found.refined.normals[box], found.start.normals[box])
    residual = found.refined.pixel_residual[box]
    most = float(np.percentile(residual[mask], 99))
    return [
        Tile("normals before", pictures.normal_map(found.start.normals[box], mask), "normals"),
        Tile("refined", pictures.normal_map(found.refined.normals[box], mask), "normals"),
        Tile("moved (yellow: 20 degrees)", pictures.error_map(np.where(mask, moved, np.nan), 20.0)),
        _draw_expected_errors(expected, mask),
        Tile(f"not explained (yellow: {most:.2f})", pictures.error_map(np.where(mask, residual, np.nan), most)),
    ]


def _draw_expected_errors(expected: np.ndarray, mask: np.ndarray) -> Tile:
    """Return a picture of the errors to expect, in degrees."""
    return Tile("error to expect (yellow: 20 degrees)", pictures.error_map(np.where(mask, expected, np.nan), 20.0))


def _brightest(result: "Inference") -> slice:
    """Return the slice of the photograph whose light is nearest to 35 degrees off the camera, or of the first."""
    if not len(result.light_directions):
        return slice(0, 1)
    number = int(np.argmin(np.abs(result.light_directions[:, 2] - np.cos(np.radians(35.0)))))
    return slice(number, number + 1)


def _tint_outside(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Tint what lies outside the mask, so that a wrong mask is seen at once."""
    tint = np.array([255.0, 80.0, 160.0])
    outside = 0.45 * picture.astype(np.float32) + 0.55 * tint
    return np.where(mask[..., None], picture, outside).astype(np.uint8)


def depth_picture(result: "Inference", box: tuple[slice, ...] = ()) -> np.ndarray:  # (H, W, 3) uint8
    """Return depth as grey, from the farthest (dark) to the nearest (bright) of each component, white outside."""
    z, mask = result.depth.z[box], result.photos.mask[box]
    low, high = np.percentile(z[mask], (0.5, 99.5))
    grey = np.clip((z - low) / max(high - low, 1e-9), 0.0, 1.0) * 225 + 15
    return np.repeat(np.where(mask, grey, 255.0)[..., None], 3, -1).astype(np.uint8)


def _tables(result: "Inference") -> tuple[Table, ...]:
    """Return the checks, the figures and the lights as tables."""
    findings = tuple((finding.level, finding.text + _list_images(finding.images)) for finding in result.findings)
    notes = tuple(("note", note) for note in result.photos.notes)
    checks = Table(title="Checks", header=("level", "what"), rows=(*findings, *notes), prose=(1,))
    facts = result.summary()
    rows = [("seconds", f"{facts['seconds']:.1f}"), ("parts of the surface", str(result.depth.components)),
            ("integrability, RMS residual", f"{result.depth.residual:.2f}°")]  # fmt: skip
    if result.residuals is not None:
        rows.append(("photographs against Lambert's law, relative RMS", f"{result.residuals.overall:.3f}"))
    rows += _refinement_rows(facts)
    if "expected_normal_error_degrees" in facts and ("fused" in facts or "refined" not in facts):
        rows.append(("error of the normals to expect", f"{facts['expected_normal_error_degrees']}°"))
    note = f"Terms of the weights: {facts['terms']}." if facts["terms"] else ""
    tables = [checks, Table(title="Figures", header=("what", "value"), rows=tuple(rows), note=note)]
    if len(result.light_directions):
        relative = scale_to_mean(grey(result.gains))
        body: tuple[tuple[str, ...], ...] = tuple(
            (name, *(f"{value:.3f}" for value in direction), f"{gain:.3f}")
            for name, direction, gain in zip(result.photos.files, result.light_directions, relative, strict=True)
        )
        header: tuple[str, ...] = ("photograph", "x", "y", "z", "intensity / mean")
        if "refined" in facts:
            expected = facts["refined"].get("expected_light_error_degrees")
            body = tuple((*row, f"{expected[row[0]]:.1f}°" if expected else "given, not known") for row in body)
            header = (*header, "error to expect")
        if not facts["lamps"]["far"]:
            away = ["far" if np.isinf(distance) else f"{distance:.2f}" for distance in result.lamp_distances]
            body = tuple((*row, distance) for row, distance in zip(body, away, strict=True))
            header = (*header, "object sizes away")
        tables.append(Table(title="Lights", header=header, rows=body, note=_tell_lamps(result)))
    return tuple(tables)


def _refinement_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what the table of figures says of refinement."""
    if "refined" not in facts:
        return []
    about = facts["refined"]
    unexplained = about["unexplained"]
    return [
        ("refined", "yes" if about["kept"] else f"no: {about['doubt']}"),
        ("refinement moved normals, lights", f"{about['normals_moved_degrees']}°, {about['lights_moved_degrees']}°"),
        ("error of the refined normals to expect", f"{about['expected_normal_error_degrees']}°"),
        ("photographs not explained", f"{len(unexplained)}{_list_images(unexplained)}"),
        *_fusion_rows(facts.get("fused")),
    ]


def _fusion_rows(about: dict[str, float] | None) -> list[tuple[str, str]]:
    """Return what the table of figures says of joining."""
    if about is None:
        return []
    away = f"{about['from_network_degrees']}°, {about['from_refinement_degrees']}°"
    return [("joined normals are away from the network's, the refined ones", away)]
