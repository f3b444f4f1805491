"""What the worker does with photographs: the example, the checks, an inference and the files the page shows.

A set of photographs is a folder with `photos` (what was uploaded), `painted.png` (a mask painted on the page), `view`
(thumbnails) and `runs/<number>`, each with `files` (what `sdps infer` writes) and `view`.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipelines.app.pages import object_view
from pipelines.shared import pictures
from render.shared.errors import InputError
from render.shared.files import write_json
from render.shared.progress import share_out, stage

PHOTOS, VIEW, PAINTED, TRUTH = "photos", "view", "painted.png", "truth.npy"
_EXAMPLE = {"shape": "bunny", "material": "red-phenolic", "lights": "near-uniform:48", "size": 256, "spp": 32}
_THUMBNAIL, _PICTURE = 112, 640
_CHECKING = {"reading": 2.0, "checks": 1.0, "pictures": 1.0}
_INFERRING = {
    "reading": 1.0, "lights": 5.0, "normals": 30.0, "refinement": 0.0, "second look": 0.0, "albedo": 1.0, "depth": 1.0,
    "surface": 1.0, "meshes": 1.0, "relit pictures": 1.0, "page": 1.0,
}  # fmt: skip
"""Stages and about how long each takes with the recommended method."""
_REFINING = {"refinement": 40.0, "second look": 20.0}


def render_example(place: str) -> dict[str, Any]:
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
    return check(place)


def check(place: str, **options: Any) -> dict[str, Any]:
    """Read and check the photographs, and make their thumbnails.

    Args:
        place: The set's folder.
        options: `gamma`, `frame`, `lights` (use the lights file among the photographs), `balls` of `sdps.load`.

    Returns:
        What the page shows.

    Raises:
        InputError: photographs that cannot be used; paths are relative to the set's folder.
    """
    from sdps import photos as photographs

    folder = Path(place)
    with share_out(_CHECKING), _shorten_paths(folder):
        stage("reading")
        photos = _load(folder, anyway=True, **options)
        stage("checks")
        findings = photographs.check(photos)
        view = folder / VIEW
        view.mkdir(exist_ok=True)
        exposure = pictures.auto_exposure(photos[0:1], photos.mask)
        for number in range(len(photos)):
            shown = pictures.tone_map(photos[number : number + 1][0], exposure)
            _save(view / f"{number}.jpg", shown, _THUMBNAIL)
            if number == len(photos) // 2:
                _save(view / "picture.jpg", shown, _PICTURE)
            stage("pictures", number + 1, len(photos))
        Image.fromarray(photos.mask.astype(np.uint8) * 255).save(view / "mask.png")
    height, width = photos.shape
    return {
        "files": list(photos.files), "width": width, "height": height, "bits": photos.bits, "gamma": str(photos.gamma),
        "mask": photos.mask_origin if not (folder / PAINTED).is_file() else "painted",
        "pixels": int(photos.mask.sum()), "notes": list(photos.notes), "lit": photos.light_directions is not None,
        "balls": [_show_ball(ball) for ball in photos.balls],
        "findings": [{"level": item.level, "text": item.text, "images": list(item.images)} for item in findings],
        "lights_there": _has_lights(folder / PHOTOS), "methods": list_methods(photos.light_directions is not None),
    }  # fmt: skip


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
    found = [{"name": "auto", "about": "the best method for these photographs (recommended)"}]
    for name, about in there.items():
        combined = name in COMBINATIONS
        classical = name in METHODS and METHODS[name].calibrated == lit
        if (combined and not lit) or classical or (name == "psfcn" and lit):
            found.append({"name": name, "about": about})
    return found


def infer(place: str, number: int, method: str, refine: bool, anyway: bool, discontinuities: bool,
          flat: Any = "auto", scale: float | str = 1.0, **options: Any) -> dict[str, Any]:  # fmt: skip
    """Run a method, write all files of `sdps infer` and what the page shows.

    Args:
        place: The set's folder.
        number: Of the run.
        refine: Refine where `sdps.infer` does by default.
        method, anyway, discontinuities, flat: As of `sdps.infer`.
        scale: As of `sdps.load`, or `auto`: what takes under ten minutes.
        options: As of `check`, `light_distance`, and `focal`: 35 mm equivalent in millimetres.

    Returns:
        What the page shows of the run.

    Raises:
        InputError: as `sdps.infer`.
    """
    import sdps
    from pipelines.evaluate.report.photographs_page import write_page

    folder = Path(place)
    run = folder / "runs" / str(number)
    _remove_failed_runs(run)
    shares = _INFERRING | (_REFINING if refine or method.endswith(("+refine", "+fuse")) else {})
    with share_out(shares), _shorten_paths(folder):
        stage("reading")
        options |= {"anyway": anyway, "whole_frame": flat in ("yes", "turned")}
        how: dict[str, Any] = {"refine": None if refine else False, "discontinuities": discontinuities}
        photos = _load(folder, scale=1.0 if scale == "auto" else float(scale), **options)
        if scale == "auto" and (quick := sdps.plan(photos, method, **how).quick) is not None:
            photos = _load(folder, scale=quick[0], **options)
        result = sdps.infer(photos, method, anyway=anyway, flat=flat, **how)
        (run / "view").mkdir(parents=True, exist_ok=True)
        shown = object_view.write(result, run / "view")
        result.save(run / "files")
        write_page(run / "files" / "report.html", result)
    shown |= {"number": number, "error": _measure_error(folder, result.normals, photos.mask)}
    write_json(run / "view" / "view.json", shown)
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


def _load(
    folder: Path, *, anyway: bool, gamma: str = "auto", frame: str = "y-up", lights: bool = False, scale: float = 1.0,
    focal: str = "", light_distance: str = "auto", balls: Sequence[str] = (), whole_frame: bool = False,
) -> Any:  # fmt: skip
    from sdps import photos

    painted = folder / PAINTED
    (pose,) = photos.find_poses(folder / PHOTOS, inside=folder)  # it has no folders, so there is one
    return photos.load(
        pose, mask=painted if painted.is_file() else None, lights="folder" if lights else None,
        frame=frame, gamma=gamma, anyway=anyway, scale=scale, balls=balls, whole_frame=whole_frame,
        light_distance=light_distance, focal=f"{focal}mm" if focal[-1:].isdigit() else focal,  # as the page asks for it
    )  # fmt: skip


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


@contextmanager
def _shorten_paths(folder: Path) -> Iterator[None]:
    """Remove the temporary folder from error messages."""
    try:
        yield
    except InputError as error:
        text = str(error).replace(f"{folder / PHOTOS}/", "").replace(str(folder / PHOTOS), "photographs")
        raise InputError(text.replace(f"{folder}/", "")) from error
