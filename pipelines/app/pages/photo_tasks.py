"""What the worker does with photographs: the example, the checks, an inference and the files the page shows.

A set of photographs is a folder with `photos` (what was uploaded), `painted.png` (a mask painted on the page), `view`
(thumbnails) and `runs/<number>`, each with `files` (what `sdps infer` writes), `view`, `asked.json` and `exports`.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from pipelines.app.common.uploads import PICTURES
from pipelines.app.pages import object_view
from pipelines.app.pages.photo_questions import (
    PAINTED,
    PHOTOS,
    find_poses,
    make_arguments,
    read_answers,
    say_plainly,
    speak_plainly,
)
from pipelines.app.pages.run_exports import ASKED, list_exports
from pipelines.shared import pictures
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.progress import share_out, stage

if TYPE_CHECKING:
    from sdps.photos import Finding, Photographs, Pose

VIEW, TRUTH = "view", "truth.npy"
_EXAMPLE = {"shape": "bunny", "material": "red-phenolic", "lights": "near-uniform:48", "size": 256, "spp": 32}
_THUMBNAIL, _PICTURE = 112, 640
_CHECKING = {"reading": 2.0, "checks": 1.0, "pictures": 1.0}
_INFERRING = {
    "reading": 1.0, "lights": 5.0, "normals": 30.0, "refinement": 0.0, "second look": 0.0, "albedo": 1.0, "depth": 1.0,
    "surface": 1.0, "meshes": 1.0, "relit pictures": 1.0, "page": 1.0,
}  # fmt: skip
"""Stages and about how long each takes with the recommended method."""
_REFINING = {"refinement": 40.0, "second look": 20.0}


def render_example(place: str, **asked: Any) -> dict[str, Any]:
    """Render the bunny under 48 lights of unequal strength as 16-bit photographs with a mask; then check them."""
    import render
    from pipelines.evaluate.workbench import write_photographs

    stage("rendering the example")
    view = render.render_view(**_EXAMPLE)  # type: ignore[arg-type]
    gains = np.random.default_rng(0).uniform(0.5, 2.0, len(view.images))
    images = view.images * gains[:, None, None, None]
    images = images / np.percentile(images[:, view.mask], 99.9)
    write_photographs(Path(place) / PHOTOS, images, view.mask)
    np.save(Path(place) / TRUTH, view.normals)
    return check(place, **asked)


def check(place: str, **asked: Any) -> dict[str, Any]:
    """Read and check the photographs, make their thumbnails, and say what a run would do.

    Args:
        place: The set's folder.
        asked: Of `photo_questions.read_answers`, or as it takes them.

    Returns:
        What the page shows.

    Raises:
        InputError: photographs that cannot be used; paths are relative to the set's folder.
    """
    from pipelines.infer import look_through

    folder, answers = Path(place), read_answers(asked)
    with share_out(_CHECKING), speak_plainly(folder):
        stage("reading")
        poses, pose = find_poses(folder, answers)
        args = make_arguments(folder, pose, answers | {"anyway": True, "scale": "1"})
        photos, findings, _ = look_through(args, pose, lambda text: None)
        _draw(photos, folder / VIEW)
        args = make_arguments(folder, pose, answers)
        work, trouble = _foresee(args, pose, photos)
    height, width = photos.shape
    return {
        "files": list(photos.files), "width": width, "height": height, "bits": photos.bits, "gamma": str(photos.gamma),
        "mask": photos.mask_origin if not (folder / PAINTED).is_file() else "painted",
        "pixels": int(photos.mask.sum()), "notes": [say_plainly(note) for note in photos.notes],
        "lit": photos.light_directions is not None,
        "balls": [_show_ball(ball) for ball in photos.balls if ball.folder is None],
        "ball_alone": next((ball.kind for ball in photos.balls if ball.folder is not None), ""),
        "findings": _list_findings(findings),
        "lights_there": _has_lights(folder / PHOTOS), "methods": list_methods(photos.light_directions is not None),
        "poses": [one.name for one in poses], "pose": pose.name, "film": pose.room is not None,
        "pictures": sorted(path.name for path in pose.folder.iterdir() if path.suffix.lower() in PICTURES),
        "work": [[name, say_plainly(text)] for name, text in work.items()], "trouble": say_plainly(trouble),
    }  # fmt: skip


def _list_findings(findings: "Sequence[Finding]") -> list[dict[str, Any]]:
    return [{"level": item.level, "text": say_plainly(item.text), "images": list(item.images)} for item in findings]


def _draw(photos: "Photographs", view: Path) -> None:
    """Write thumbnails, the picture that is painted on, and the mask."""
    view.mkdir(exist_ok=True)
    exposure = pictures.auto_exposure(photos[0:1], photos.mask)
    for number in range(len(photos)):
        shown = pictures.tone_map(photos[number : number + 1][0], exposure)
        _save(view / f"{number}.jpg", shown, _THUMBNAIL)
        if number == len(photos) // 2:
            _save(view / "picture.jpg", shown, _PICTURE)
        stage("pictures", number + 1, len(photos))
    Image.fromarray(photos.mask.astype(np.uint8) * 255).save(view / "mask.png")


def _foresee(args: argparse.Namespace, pose: "Pose", photos: "Photographs") -> tuple[dict[str, str], str]:
    """Return what `sdps infer --dry-run` says of photographs of full size, by name, and what would stop a run."""
    from pipelines.infer import look_through
    from pipelines.shared import dry_run
    from sdps.api import plan

    told: list[str] = []
    try:
        options: dict[str, Any] = {"refine": args.refine, "discontinuities": args.discontinuities}
        options |= {"flat": args.flat, "flatten": args.flatten, "lit_by": args.lit_by}
        expected = plan(photos, args.method, **options)
        if args.scale != 1.0 and (args.scale != "auto" or expected.quick is not None):
            photos, _, options = look_through(args, pose, told.append)
            expected = plan(photos, args.method, **options)
        rows = {"time": expected.describe()} | dry_run.list_input(photos) | dry_run.list_work(expected, "the ZIP")
        if not args.anyway:
            expected.check()
    except InputError as error:
        return {}, str(error)
    return rows, ""


def _show_ball(ball: Any) -> dict[str, Any]:
    """Return what the page draws of a ball, in pixels of the files."""
    spots = ball.highlights[np.isfinite(ball.highlights[:, 0])].round(2).tolist()
    circle = {key: round(value, 2) for key, value in ball.circle._asdict().items()}
    return {**circle, "kind": ball.kind, "highlights": spots}


def list_methods(lit: bool) -> list[dict[str, str]]:
    """Return the methods that can be used, the recommended one first.

    Args:
        lit: The light directions are known.
    """
    import sdps
    from sdps.classical.registry import METHODS
    from sdps.models.registry import COMBINATIONS

    there = sdps.available_methods()
    found = [{"name": "auto", "about": "the best there is for these photographs"}]
    for name, about in there.items():
        combined = name in COMBINATIONS
        classical = name in METHODS and METHODS[name].calibrated == lit
        if (combined and not lit) or classical or (lit and name == "psfcn"):
            found.append({"name": name, "about": about})
    return found


def infer(place: str, number: int, **asked: Any) -> dict[str, Any]:
    """Run a method, write all files of `sdps infer` and what the page shows.

    Args:
        place: The set's folder.
        number: Of the run.
        asked: As of `check`.

    Returns:
        What the page shows of the run.

    Raises:
        InputError: as `sdps.infer`.
    """
    from pipelines.evaluate.report.photographs_page import write_page
    from pipelines.infer import infer_pose

    folder, answers = Path(place), read_answers(asked)
    run = folder / "runs" / str(number)
    _remove_failed_runs(run)
    refined = answers["refine"] or answers["method"].endswith(("+refine", "+fuse"))
    with share_out(_INFERRING | (_REFINING if refined else {})), speak_plainly(folder):
        stage("reading")
        poses, pose = find_poses(folder, answers)
        result, said = infer_pose(make_arguments(folder, pose, answers), pose, lambda text: None)
        (run / VIEW).mkdir(parents=True, exist_ok=True)
        shown = object_view.write(result, run / VIEW)
        result.save(run / "files")
        write_page(run / "files" / "report.html", result)
    shown |= {"number": number, "error": _measure_error(folder, result.normals, result.photos.mask)}
    shown |= {"pose": pose.name if len(poses) > 1 else "", "exports": list_exports()}
    shown["findings"] = _list_findings(result.findings[said:])
    shown |= {key: say_plainly(shown[key]) for key in ("verdict", "camera", "lamps")}
    write_json(run / ASKED, answers)
    write_json(run / VIEW / "view.json", shown)
    return shown


def _remove_failed_runs(run: Path) -> None:
    """Remove files of earlier runs that failed or were cancelled; this run has the highest number."""
    for old in run.parent.glob("*"):
        if int(old.name) < int(run.name) and not (old / VIEW / "view.json").is_file():
            shutil.rmtree(old, ignore_errors=True)


def _measure_error(folder: Path, normals: np.ndarray, mask: np.ndarray) -> float | None:
    """Return the mean angular error in degrees if the truth is known, as for the example."""
    if not (folder / TRUTH).is_file():
        return None
    from sdps.core.metrics import normal_mae

    truth = np.load(folder / TRUTH)
    if truth.shape != normals.shape:  # at another scale
        return None
    return round(normal_mae(normals, truth, mask & (np.linalg.norm(truth, axis=-1) > 0.5)), 2)


def _has_lights(folder: Path) -> bool:
    """Return whether there is a lights file; if there are several, `_load` reports that."""
    from sdps.photos.light_files import find_lights

    try:
        return find_lights(folder) is not None
    except InputError:
        return True


def _save(path: Path, picture: np.ndarray, side: int) -> None:
    image = Image.fromarray(picture)
    image.thumbnail((side, side))
    image.save(path, quality=88)
