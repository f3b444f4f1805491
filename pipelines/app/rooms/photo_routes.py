"""The room "Photographs": uploads, masks, inferences and what they made."""

import asyncio
import io
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.rooms.handling import file_inside, number, queued, taking_uploads
from pipelines.app.work import uploads
from pipelines.app.work.archives import unpack
from pipelines.app.work.incoming import Incoming, incoming, names, off_loop, receive
from pipelines.app.work.jobs import finite
from pipelines.app.work.refusals import Refused
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
_PACKING = threading.Lock()


async def new(request: Request) -> Response:
    """Begin a set of photographs; the one unused for longest goes where there are a dozen."""
    session: Session = request.state.session
    gone = session.set_aside(_MOST_SETS - 1, request.app.state.jobs.works_in)
    name = session.new_place()
    (session.folder / name / PHOTOS).mkdir()
    await off_loop(session.clear, gone)
    return JSONResponse({"set": name})


@taking_uploads
async def upload(request: Request) -> Response:
    """Take one file, or a ZIP that is unpacked at once: all of its files or none."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    name, given = request.path_params["set"], request.path_params["name"]
    folder = session.place(name) / PHOTOS
    zipped = given.lower().endswith(".zip")
    given = uploads.safe_name(given, (".zip",)) if zipped else uploads.safe_name(given)
    if len(names(folder)) >= limits.files:
        raise InputError(f"more than {limits.files} files; leave some out")
    async with incoming(session, limits.bytes, name) as coming:
        path = coming.folder / given
        await receive(request.stream(), path, coming, uploads.most_bytes(given))
        there = await off_loop(_take_in, coming, path, folder, limits)
    return JSONResponse({"files": there})


def _take_in(coming: Incoming, path: Path, folder: Path, limits: Limits) -> int:
    """Check what was uploaded, and move it into a set's folder; return how many files lie there then."""
    if path.suffix.lower() == ".zip":
        return coming.add(unpack(path, coming.folder / "unpacked", limits, coming), folder, limits.files)
    uploads.check_pixels(path, limits)
    return coming.add([path], folder, limits.files)


@taking_uploads
async def paint(request: Request) -> Response:
    """Take a mask painted on the page, a PNG of the photographs' size; an empty body takes the painted one away."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    name = request.path_params["set"]
    folder = session.place(name)
    async with incoming(session, limits.bytes, f"{name}/{PAINTED}") as coming:
        path = coming.folder / "mask.png"
        if await receive(request.stream(), path, coming, _MOST_MASK):
            await off_loop(_keep_mask, coming, path, folder / PAINTED, limits)
        else:
            coming.remove(folder / PAINTED)
    return JSONResponse({})


def _keep_mask(coming: Incoming, source: Path, target: Path, limits: Limits) -> None:
    uploads.check_pixels(source, limits)
    with decoding(source.name, "a PNG picture", "paint it again"), Image.open(source, formats=["PNG"]) as image:
        grey = np.asarray(image.convert("L")) > 127
    if not grey.any():
        raise InputError("the mask is empty; paint over the object")
    written = io.BytesIO()
    Image.fromarray(grey.astype(np.uint8) * 255).save(written, "png")
    received, made = coming.size, coming.folder / target.name
    coming.take(len(written.getbuffer()), "the mask: too large")
    made.write_bytes(written.getbuffer())
    source.unlink()
    coming.give(received)
    coming.put(made, target)


async def start(request: Request) -> Response:
    """Queue a task on a set: the example, the checks or an inference."""
    session: Session = request.state.session
    name, task = request.path_params["set"], request.path_params["task"]
    if task not in _TASKS:
        raise unknown("task", task, _TASKS)
    asked = await uploads.settings(request.stream()) if task != "example" else {}
    place = session.place(name)  # looked for after the wait: it may have gone meanwhile
    arguments: dict[str, Any] = {"place": str(place)}
    if task != "example":
        arguments |= {"gamma": _one_of(asked, "gamma", _GAMMAS), "lights": asked.get("lights") is True}
        arguments["frame"] = str(asked.get("frame", "y-up"))[:40]
    run = None
    if task == "infer":
        runs = [int(path.name) for path in (place / "runs").glob("*")]
        if len(runs) >= _MOST_RUNS:
            raise InputError(f"{_MOST_RUNS} runs on one set are enough here; load the photographs again")
        latest = max(runs, default=0) + 1
        run = place / "runs" / str(latest)
        run.mkdir(parents=True)
        arguments |= {"number": latest, "method": str(asked.get("method", "auto"))[:80]}
        arguments |= {key: asked.get(key) is True for key in ("refine", "anyway", "discontinuities")}
        arguments["scale"] = float(_one_of(asked, "scale", _SCALES))
    try:
        return queued(request, task, **arguments)
    except Refused:
        if run is not None:
            run.rmdir()
        raise


def _one_of(asked: dict[str, Any], key: str, known: tuple[str, ...]) -> str:
    value = str(asked.get(key, known[0]))
    if value not in known:
        raise InputError(f"{key}: must be one of {', '.join(known)}")
    return value


async def file(request: Request) -> Response:
    """Send a file that the session's set holds, and nothing outside it."""
    path = file_inside(request.state.session.place(request.path_params["set"]), request.path_params["path"])
    if path is None:
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path)


async def pixel(request: Request) -> Response:
    """Send what one pixel measures in every photograph, and what the model says it should."""
    view = _run(request) / "view"
    try:
        row, column = (int(request.query_params[key]) for key in ("row", "column"))
    except (KeyError, ValueError) as error:
        raise InputError("row and column must be numbers inside the picture") from error
    return JSONResponse(finite(await asyncio.to_thread(_measured, view, row, column)))


def _measured(view: Path, row: int, column: int) -> dict[str, list[float]]:
    found = {}
    for name in ("observed", "model"):
        if (view / f"{name}.npy").is_file():
            values = np.load(view / f"{name}.npy", mmap_mode="r")
            if not (0 <= row < values.shape[0] and 0 <= column < values.shape[1]):
                raise InputError("outside the picture; row and column must be numbers inside it")
            found[name] = np.asarray(values[row, column], np.float64).round(5).tolist()
    return found


async def download(request: Request) -> Response:
    """Send everything `sdps infer` wrote as one ZIP."""
    run = _run(request)
    archive = run / "sdps-infer.zip"
    await off_loop(_pack, run / "files", archive)
    return FileResponse(archive, filename=archive.name)


def _pack(folder: Path, archive: Path) -> None:
    with _PACKING:  # two who ask for the same would write to the same
        if archive.is_file():
            return
        with atomic_path(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as opened:
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    opened.write(path, path.relative_to(folder))


def _run(request: Request) -> Path:
    run = request.state.session.place(request.path_params["set"]) / "runs" / str(number(request, "run"))
    if not (run / "view" / "view.json").is_file():
        raise InputError("that run is no longer here; start it again")
    return run


ROUTES = [
    Route("/sets", new, methods=["POST"]),
    Route("/sets/{set}/uploads/{name}", upload, methods=["PUT"]),
    Route("/sets/{set}/mask", paint, methods=["PUT"]),
    Route("/sets/{set}/start/{task}", start, methods=["POST"]),
    Route("/sets/{set}/files/{path:path}", file),
    Route("/sets/{set}/runs/{run}/pixel", pixel),
    Route("/sets/{set}/runs/{run}/download", download),
]
