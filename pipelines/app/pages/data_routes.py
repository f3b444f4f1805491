"""The page "Data and runs": scenes, learning curves and results of one folder on this machine."""

import asyncio
import json
import math
import os
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.common.jobs import replace_nonfinite
from pipelines.app.pages.handling import find_file, find_tab_folder, make_tab_folder, queue_task
from pipelines.evaluate.report.sections import FOLDER as REPORT
from pipelines.evaluate.report.sections import read_sections
from pipelines.shared import pictures
from render.records.ledger import survey
from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.shards import read_shard
from render.shared.config import to_plain
from render.shared.errors import InputError
from render.shared.files import read_whole_lines

_PAGE = "data"
_DEEP, _MOST = 4, 300
_SIDE = 96
_POINTS = 400  # of a learning curve


def _find_folder(request: Request) -> Path:
    """Return the folder a request names, which must be inside the one that is shown.

    Raises:
        InputError: it is not inside, or does not exist.
    """
    root = Path(request.app.state.folder).resolve()
    with suppress(OSError, ValueError):  # the name is too long or contains a zero byte
        folder = (root / request.query_params.get("folder", ".")).resolve()
        if folder.is_relative_to(root) and folder.is_dir():
            return folder
    raise InputError("there is no such folder; load the page again")


async def send_listing(request: Request) -> Response:
    """Send the list of data folders and runs, newest first."""
    root = Path(request.app.state.folder).resolve()
    rows = await asyncio.to_thread(_list_rows, root)
    return JSONResponse({"root": str(request.app.state.folder), "rows": rows})


def _list_rows(root: Path) -> list[dict[str, str]]:
    found = sorted(_find_folders(root), reverse=True)[:_MOST]
    return [{"folder": str(path.relative_to(root)), "kind": kind} for _, kind, path in found]


def _find_folders(root: Path) -> Iterator[tuple[float, str, Path]]:
    for place, folders, files in os.walk(root):
        path = Path(place)
        # Folders may be removed meanwhile, and names that are not valid text cannot be sent.
        with suppress(OSError, UnicodeEncodeError):
            place.encode()
            if MANIFEST in files:
                yield (path / MANIFEST).stat().st_mtime, "data", path
            if REPORT in folders or any((path / "models").glob("*/metrics.jsonl")):
                yield path.stat().st_mtime, "run", path
        deep = len(path.relative_to(root).parts) >= _DEEP
        folders[:] = [] if deep else [name for name in folders if name not in ("shards", "models", REPORT, "log")]


async def send_scenes(request: Request) -> Response:
    """Send the scenes of a data folder and the state of each."""
    folder = _find_folder(request)
    return JSONResponse(await asyncio.to_thread(_read_scenes, folder))


def _read_scenes(folder: Path) -> list[dict[str, Any]]:
    manifest = read_manifest(folder)
    failed = survey(folder, manifest).failed
    return [_describe_scene(scene, folder, failed.get(scene.id)) for scene in manifest]


def _describe_scene(scene: SceneSpec, folder: Path, failures: list[dict[str, Any]] | None) -> dict[str, Any]:
    there = (folder / scene.file).is_file()
    return {
        "id": scene.id, "shape": scene.shape, "material": scene.material, "split": scene.split,
        "lights": len(scene.lights), "size": scene.resolution[0],
        "state": "rendered" if there else "failed" if failures else "planned",
        "reason": str(failures[-1].get("reason", "")) if failures and not there else "",
    }  # fmt: skip


async def send_scene(request: Request) -> Response:
    """Send the strip of pictures and the mean radiance of one scene."""
    folder, name = _find_folder(request), request.query_params.get("id")
    async with request.app.state.reading:
        found = await asyncio.to_thread(_read_scene, folder, name)
    return JSONResponse(found)


def _read_scene(folder: Path, name: str | None) -> dict[str, Any]:
    chosen = _find_scene(folder, name)
    path = folder / chosen.file
    return _draw_strip(path, chosen, _read_time(path))


@lru_cache(maxsize=1024)
def _draw_strip(path: Path, scene: SceneSpec, _time: int) -> dict[str, Any]:
    shard = read_shard(path, scene)
    strip = pictures.scale_to_height(pictures.preview_strip(shard, lights=3), _SIDE)
    inside = shard.images[:, shard.mask]
    mean = float(inside.mean(dtype="float64")) if inside.size else math.nan
    return replace_nonfinite({"picture": pictures.data_uri(strip, quality=82), "radiance": round(mean, 5)})


def _find_scene(folder: Path, name: str | None) -> SceneSpec:
    """Return a scene of a data folder; for a large folder this takes seconds, so not on the event loop.

    Raises:
        InputError: there is no scene of this name.
    """
    chosen = _index_manifest(folder, _read_time(folder / MANIFEST)).get(name or "")
    if chosen is None:
        raise InputError("there is no such scene; load the page again")
    return chosen


@lru_cache(maxsize=4)
def _index_manifest(folder: Path, _time: int) -> dict[str, SceneSpec]:
    return {scene.id: scene for scene in read_manifest(folder)}


def _read_time(path: Path) -> int:
    """Return when a file was changed, in nanoseconds; 0 if there is none, which its reader will report."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


async def start_lamp(request: Request) -> Response:
    """Queue the preparation of a scene for the lamp."""
    folder = _find_folder(request)
    chosen = await asyncio.to_thread(_find_scene, folder, request.query_params.get("id"))
    place = make_tab_folder(request, _PAGE)
    return queue_task(request, "shard", place=str(place), shard=str(folder / chosen.file))


async def send_file(request: Request) -> Response:
    """Send a file of the tab's scene under the lamp."""
    name = request.path_params["name"]
    path = find_tab_folder(request, _PAGE) / name
    if name not in ("basis.bin", "truth.bin") or not path.is_file():
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path)


async def send_curves(request: Request) -> Response:
    """Send the learning curves of a run as they are now: {model: {metric: [[step, value], ...]}}."""
    folder = _find_folder(request)
    return JSONResponse(await asyncio.to_thread(_read_curves, folder))


def _read_curves(folder: Path) -> dict[str, dict[str, list[list[float]]]]:
    found: dict[str, dict[str, list[list[float]]]] = {}
    for path in sorted((folder / "models").glob("*/metrics.jsonl")):
        series: dict[str, list[list[float]]] = {}
        for row in read_whole_lines(path):
            for key, value in row.items() if isinstance(row, dict) and "step" in row else ():
                if (key == "loss" or key.startswith("val_")) and _can_be_drawn(value) and _can_be_drawn(row["step"]):
                    series.setdefault(key, []).append([row["step"], value])
        found[path.parent.name] = {key: _thin(values) for key, values in series.items()}
    return found


def _can_be_drawn(value: object) -> bool:
    """Return whether a value can be plotted; those of a diverged training cannot."""
    return isinstance(value, int | float) and abs(value) < 1e300  # NaN is not below it either


def _thin(values: list[list[float]]) -> list[list[float]]:
    step = -(-len(values) // _POINTS)
    return values[::step] + ([values[-1]] if (len(values) - 1) % step else [])


async def send_sections(request: Request) -> Response:
    """Send the evaluation: text, tables and the names of the pictures."""
    folder = _find_folder(request)
    return Response(await asyncio.to_thread(_read_sections, folder), media_type="application/json")


def _read_sections(folder: Path) -> str:
    return json.dumps(replace_nonfinite([to_plain(section) for _, section in read_sections(folder)]))


async def send_picture(request: Request) -> Response:
    """Send a picture of a section."""
    report = _find_folder(request) / REPORT
    path = find_file(report, f"{request.query_params.get('section', '')}/{request.query_params.get('file', '')}")
    if path is None or path.suffix not in (".png", ".jpg"):
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path)


ROUTES = [
    Route("/list", send_listing),
    Route("/scenes", send_scenes),
    Route("/scene", send_scene),
    Route("/start", start_lamp, methods=["POST"]),
    Route("/files/{name}", send_file),
    Route("/curves", send_curves),
    Route("/sections", send_sections),
    Route("/picture", send_picture),
]
