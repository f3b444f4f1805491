"""The room "Photographs": uploads, masks, inferences and what they made."""

import asyncio
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.work import uploads
from pipelines.app.work.sessions import Session
from pipelines.app.work.uploads import Limits
from render.shared.decoding import decoding
from render.shared.errors import InputError, unknown
from render.shared.files import atomic_path

PHOTOS, PAINTED = "photos", "painted.png"
_GAMMAS = ("auto", "linear", "srgb", "2.2")
_SCALES = ("1", "0.5", "0.25")
_TASKS = ("example", "check", "infer")
_MOST_MASK = 32 * 2**20
_MOST_RUNS = 20
_MOST_SETS = 12


async def new(request: Request) -> Response:
    """Begin a set of photographs; the oldest above a dozen goes."""
    session: Session = request.state.session
    for old in sorted(session.folder.iterdir(), key=lambda path: path.stat().st_mtime)[: -_MOST_SETS + 1]:
        session.taken -= sum(path.stat().st_size for path in (old / PHOTOS).glob("*"))
        await asyncio.to_thread(shutil.rmtree, old, True)
    name = session.new_place()
    (session.folder / name / PHOTOS).mkdir()
    return JSONResponse({"set": name})


async def upload(request: Request) -> Response:
    """Take one file, or a ZIP that is unpacked at once."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    folder = session.place(request.path_params["set"]) / PHOTOS
    given = request.path_params["name"]
    room = limits.bytes - session.taken
    if given.lower().endswith(".zip"):
        archive = folder.parent / uploads.safe_name(given, (".zip",))
        session.taken += await uploads.receive_archive(request.stream(), archive, folder, limits, room)
    else:
        if len(os.listdir(folder)) >= limits.files:
            raise InputError(f"more than {limits.files} files; leave some out")
        path = folder / uploads.safe_name(given)
        session.taken += await uploads.receive(request.stream(), path, room)
        try:
            await asyncio.to_thread(uploads.check_pixels, path, limits)
        except InputError:
            path.unlink()
            raise
    return JSONResponse({"files": len(os.listdir(folder))})


async def paint(request: Request) -> Response:
    """Take a mask painted on the page, a PNG of the photographs' size; an empty body takes the painted one away."""
    limits: Limits = request.app.state.limits
    folder = request.state.session.place(request.path_params["set"])
    incoming = folder / "incoming.png"
    incoming.unlink(missing_ok=True)
    try:
        if await uploads.receive(request.stream(), incoming, _MOST_MASK) == 0:
            (folder / PAINTED).unlink(missing_ok=True)
            return JSONResponse({})
        uploads.check_pixels(incoming, limits)
        await asyncio.to_thread(_keep_mask, incoming, folder / PAINTED)
    finally:
        incoming.unlink(missing_ok=True)
    return JSONResponse({})


def _keep_mask(source: Path, target: Path) -> None:
    with decoding(source.name, "a PNG picture", "paint it again"), Image.open(source, formats=["PNG"]) as image:
        grey = np.asarray(image.convert("L")) > 127
    if not grey.any():
        raise InputError("the mask is empty; paint over the object")
    with atomic_path(target) as temporary:
        Image.fromarray(grey.astype(np.uint8) * 255).save(temporary)


async def start(request: Request) -> Response:
    """Queue a task on a set: the example, the checks or an inference."""
    session: Session = request.state.session
    name, task = request.path_params["set"], request.path_params["task"]
    place = session.place(name)
    if task not in _TASKS:
        raise unknown("task", task, _TASKS)
    asked = await uploads.settings(request.stream()) if task != "example" else {}
    arguments: dict[str, Any] = {"place": str(place)}
    if task != "example":
        arguments |= {"gamma": _one_of(asked, "gamma", _GAMMAS), "lights": asked.get("lights") is True}
        arguments["frame"] = str(asked.get("frame", "y-up"))[:40]
    if task == "infer":
        number = max([int(path.name) for path in (place / "runs").glob("*")], default=0) + 1
        if number > _MOST_RUNS:
            raise InputError(f"{_MOST_RUNS} runs on one set are enough here; load the photographs again")
        (place / "runs" / str(number)).mkdir(parents=True)
        arguments |= {"number": number, "method": str(asked.get("method", "auto"))[:80]}
        arguments |= {key: asked.get(key) is True for key in ("refine", "anyway", "discontinuities")}
        arguments["scale"] = float(_one_of(asked, "scale", _SCALES))
    job = request.app.state.jobs.submit(session.token, task, **arguments)
    if job is None:
        raise InputError("too many jobs wait; try again in a minute")
    return JSONResponse(request.app.state.jobs.describe(job))


def _one_of(asked: dict[str, Any], key: str, known: tuple[str, ...]) -> str:
    value = str(asked.get(key, known[0]))
    if value not in known:
        raise InputError(f"{key}: must be one of {', '.join(known)}")
    return value


async def file(request: Request) -> Response:
    """Send a file that the session's set holds, and nothing outside it."""
    folder = request.state.session.place(request.path_params["set"]).resolve()
    path = (folder / request.path_params["path"]).resolve()
    if not path.is_relative_to(folder) or not path.is_file():
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path)


async def pixel(request: Request) -> Response:
    """Send what one pixel measures in every photograph, and what the model says it should."""
    view = _run(request) / "view"
    try:
        row, column = (int(request.query_params[key]) for key in ("row", "column"))
        found = {}
        for name in ("observed", "model"):
            if (view / f"{name}.npy").is_file():
                values = np.load(view / f"{name}.npy", mmap_mode="r")
                if not (0 <= row < values.shape[0] and 0 <= column < values.shape[1]):
                    raise InputError("outside the picture")
                found[name] = np.asarray(values[row, column], np.float64).round(5).tolist()
    except (KeyError, ValueError) as error:
        raise InputError("row and column must be numbers inside the picture") from error
    return JSONResponse(found)


async def download(request: Request) -> Response:
    """Send everything `sdps infer` wrote as one ZIP."""
    run = _run(request)
    archive = run / "sdps-infer.zip"
    if not archive.is_file():
        await asyncio.to_thread(_pack, run / "files", archive)
    return FileResponse(archive, filename=archive.name)


def _pack(folder: Path, archive: Path) -> None:
    with atomic_path(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as opened:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                opened.write(path, path.relative_to(folder))


def _run(request: Request) -> Path:
    run = request.state.session.place(request.path_params["set"]) / "runs" / str(request.path_params["run"])
    if not (run / "view" / "view.json").is_file():
        raise InputError("that run is no longer here; start it again")
    return run


ROUTES = [
    Route("/sets", new, methods=["POST"]),
    Route("/sets/{set}/uploads/{name}", upload, methods=["PUT"]),
    Route("/sets/{set}/mask", paint, methods=["PUT"]),
    Route("/sets/{set}/start/{task}", start, methods=["POST"]),
    Route("/sets/{set}/files/{path:path}", file),
    Route("/sets/{set}/runs/{run:int}/pixel", pixel),
    Route("/sets/{set}/runs/{run:int}/download", download),
]
