"""`sdps infer`: photographs under moving light in, normals, lights, depth, meshes and a page out."""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.evaluate.report.photographs_page import MARKS, describe, name_camera, tell_lamps, write_page
from pipelines.export_result import FOLDER, choose_exports
from pipelines.infer_flags import AUTO, add_arguments
from pipelines.shared import dry_run
from render.shared.errors import InputError
from render.shared.progress import bars

if TYPE_CHECKING:
    from sdps.api import Inference
    from sdps.photos import Finding, Photographs, Pose

__all__ = ["add_arguments", "main"]


def main(args: argparse.Namespace) -> int:
    """Check the photographs, run the method, write the results; with `--self-test` on photographs made for it."""
    if args.self_test:
        from pipelines.evaluate.self_test import photograph_bunny

        args.folder = photograph_bunny(args.out / "photographs")
    if args.folder is None and Path(args.flat).is_dir():  # `--flat photographs`: a folder, not a choice
        args.folder, args.flat = Path(args.flat), "yes"
    if args.folder is None:
        raise InputError("name a folder of photographs, or use --self-test")
    exports = choose_exports(args.export, args.normals)
    from sdps.api import check_out
    from sdps.photos import find_poses

    check_out(args.out, args.folder)
    poses = find_poses(args.folder, args.every)
    if len(poses) > 1:
        return _infer_poses(args, poses, exports)
    with bars(without=("reading", "checks", "refinement")):  # these have their own
        if args.dry_run:
            return rehearse(args, poses[0])
        result, said = infer_pose(args, poses[0], sys.stdout.write)
        made = result.save(args.out)
        exported = _export(args.out, exports, result.photos) if exports else ""
        page = write_page(args.out / "report.html", result)
    if args.self_test:
        from pipelines.evaluate.self_test import compare

        sys.stdout.write(compare(args.folder, result, args.out))
    sys.stdout.write(describe(result.findings[said:]))
    sys.stdout.write(f"{tell_lamps(result)}\n")
    sys.stdout.write(
        f"{result.method}: {result.seconds:.1f} s; {', '.join(path.name for path in made)}\n{exported}{page}\n"
    )
    if result.verdict:
        sys.stdout.write(f"{MARKS['error']} {result.verdict}\n")
    return 0


def _export(folder: Path, names: Sequence[str], photos: "Photographs") -> str:
    """Write exports of what was just saved, and say it, one a line; one that the result lacks something for is said."""
    from sdps.surface.exports.registry import write_exports
    from sdps.surface.exports.saved_result import read_result

    result, said = dataclasses.replace(read_result(folder), pictures=photos), []
    for name in names:
        try:
            made = write_exports(result, [name], folder / FOLDER)
            said.append(f"{folder / FOLDER / name}: {', '.join(path.name for path in made)}\n")
        except InputError as error:
            said.append(f"{MARKS['warning']}{name} was not exported: {error}\n")
    return "".join(said)


def _infer_poses(args: argparse.Namespace, poses: "Sequence[Pose]", exports: Sequence[str]) -> int:
    """Run all poses, each into a folder of its name, with a line for each; one that fails stops no other.

    Raises:
        InputError: at the end, with the names of those that failed.
    """
    from sdps.api import check_out

    failed = []
    sys.stdout.write(f"{len(poses)} poses: {', '.join(pose.name for pose in poses)}\n")
    for pose in poses:
        out = args.out / pose.name
        try:
            check_out(out, pose.folder)
            with bars(without=("reading", "checks", "refinement")):
                result, _ = infer_pose(args, pose, lambda text: None)
                result.save(out)
                exported = _export(out, exports, result.photos) if exports else ""
                page = write_page(out / "report.html", result)
        except InputError as error:
            failed.append(pose.name)
            sys.stdout.write(f"{MARKS['error']} {pose.name}: {error}\n")
        else:
            sys.stdout.write(f"{exported}{pose.name}: {_summarise(result)}; {page}\n")
        sys.stdout.flush()
    if failed:
        raise InputError(
            f"{args.folder}: {len(failed)} of {len(poses)} poses failed, for the reasons above: {', '.join(failed)}"
        )
    return 0


def _summarise(result: "Inference") -> str:
    """Return how a pose went, in a line."""
    parts = [f"{result.method}, {len(result.photos)} photographs, {result.seconds:.1f} s"]
    error = result.summary().get("expected_normal_error_degrees")
    parts += [] if error is None else [f"error of the normals to expect {error}°"]
    warnings = sum(finding.level != "note" for finding in result.findings)
    parts += [f"{warnings} {'warning' if warnings == 1 else 'warnings'} on the page"] if warnings else []
    return "; ".join([*parts, result.verdict] if result.verdict else parts)


def infer_pose(args: argparse.Namespace, pose: "Pose", tell: Callable[[str], object]) -> tuple["Inference", int]:
    """Read the photographs, tell what was found about them, and run the method; also return how many were told."""
    from sdps.api import infer, plan

    photos, findings, options = look_through(args, pose, tell)
    if args.anyway or not any(finding.level == "error" for finding in findings):
        tell(f"{plan(photos, args.method, **options).describe()}\n")
        sys.stdout.flush()
    with pose.naming():
        return infer(photos, args.method, **options, findings=findings, anyway=args.anyway), len(findings)


def rehearse(args: argparse.Namespace, pose: "Pose") -> int:
    """Say what was understood of the photographs and what `infer_pose` would do; write nothing.

    Raises:
        InputError: what would stop it.
    """
    from sdps.api import ask_about_lights, plan, stop

    photos, findings, options = look_through(args, pose, sys.stdout.write)
    sys.stdout.write(dry_run.write_rows(dry_run.list_input(photos)))
    expected = plan(photos, args.method, **options)
    sys.stdout.write(f"{expected.describe()}\n{dry_run.write_rows(dry_run.list_work(expected, args.out))}")
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


def look_through(
    args: argparse.Namespace, pose: "Pose", tell: Callable[[str], object]
) -> tuple["Photographs", "tuple[Finding, ...]", dict[str, Any]]:
    """Read the photographs and tell what was found about them; also return findings, and options as of `sdps.infer`."""
    from sdps.api import load, plan
    from sdps.inference.inference_config import inference_config
    from sdps.methods.flat_things import Flatness
    from sdps.photos import check

    options = {"models": args.models, "config": inference_config(args), "refine": args.refine,
               "discontinuities": args.discontinuities, "flat": args.flat, "flatten": args.flatten,
               "lit_by": args.lit_by}  # fmt: skip
    flat = Flatness(args.flat, args.flatten)

    def read(scale: float) -> "Photographs":
        return load(
            pose, mask=args.mask, lights=args.lights, intensities=args.intensities, frame=args.frame,
            gamma=args.gamma, names=args.images, anyway=args.anyway, scale=scale, focal=args.focal,
            principal=args.principal, pixel_size=args.pixel_size, light_distance=args.light_distance, balls=args.ball,
            ball_radius=args.ball_radius, ambient=args.ambient, dark=args.dark, whole_frame=flat.asked,
        )  # fmt: skip

    photos = read(1.0 if args.scale == AUTO else args.scale)
    if args.scale == AUTO and (quick := plan(photos, args.method, **options).quick) is not None:
        tell(f"- reduced by --scale {quick[0]:g}, so that it takes less time and memory\n")
        photos = read(quick[0])
    findings = tuple(check(photos))
    height, width = photos.shape
    tell(f"{len(photos)} photographs of {width}x{height}; the camera is {name_camera(photos)}\n")
    tell("".join(f"- {note}\n" for note in photos.notes) + describe(findings))
    return photos, findings, options
