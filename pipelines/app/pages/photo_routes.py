"""The page "Photographs": uploads, masks, inferences and their results."""

import asyncio
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.common import uploads
from pipelines.app.common.archives import pack, unpack
from pipelines.app.common.incoming import Incoming, list_files, open_upload, receive, run_in_thread
from pipelines.app.common.jobs import replace_nonfinite
from pipelines.app.common.refusals import Refused
from pipelines.app.common.sessions import Session
from pipelines.app.common.uploads import Limits
from pipelines.app.pages.handling import accept_uploads, find_file, queue_task, read_number
from pipelines.app.pages.photo_questions import BALL, PAINTED, PHOTOS, read_answers
from render.shared.decoding import decoding
from render.shared.errors import InputError, unknown

_TASKS = ("example", "check", "infer", "export")
_MOST_MASK = 32 * 2**20
_MOST_RUNS = 20
_MOST_SETS = 12
_GONE = "that run was removed; start it again"


async def make_set(request: Request) -> Response:
    """Start a set of photographs; if there are a dozen, the one unused for longest is removed."""
    session: Session = request.state.session
    gone = session.set_aside(_MOST_SETS - 1, request.app.state.jobs.works_in)
    name = session.make_place()
    (session.folder / name / PHOTOS).mkdir()
    await run_in_thread(session.clear, gone)
    return JSONResponse({"set": name})


@accept_uploads
async def upload(request: Request) -> Response:
    """Receive a photograph, a picture of a ball alone, or a ZIP, which is unpacked at once: all or nothing."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    name, given = request.path_params["set"], request.path_params["name"]
    place, ball = session.find_place(name), "ball" in request.path_params
    folder = place / (BALL.format(read_number(request, "ball")) if ball else PHOTOS)
    zipped = given.lower().endswith(".zip")
    given = str(uploads.clean_place(given, (".zip",) if zipped else uploads.USABLE))
    if ball:
        given = Path(given).name
        folder.mkdir(exist_ok=True)
    if len(list_files(folder)) >= limits.files:
        raise InputError(f"more than {limits.files} files; leave some out")
    async with open_upload(session, limits.bytes, name) as coming:
        path = coming.folder / given
        path.parent.mkdir(exist_ok=True)
        await receive(request.stream(), path, coming, uploads.most_bytes(given))
        there = await run_in_thread(_accept, coming, path, folder, limits)
    return JSONResponse({"files": there})


def _accept(coming: Incoming, path: Path, folder: Path, limits: Limits) -> int:
    """Check an upload and move it into a set's folder; return how many files are there then."""
    if path.suffix.lower() == ".zip":
        base = coming.folder / "unpacked"
        return coming.add(unpack(path, base, limits, coming), folder, limits.files, base)
    uploads.check_pixels(path, limits)
    return coming.add([path], folder, limits.files, coming.folder)


@accept_uploads
async def upload_mask(request: Request) -> Response:
    """Receive a mask painted on the page, a PNG of the photographs' size; an empty body removes the painted mask."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    name = request.path_params["set"]
    folder = session.find_place(name)
    async with open_upload(session, limits.bytes, f"{name}/{PAINTED}") as coming:
        path = coming.folder / "mask.png"
        if await receive(request.stream(), path, coming, _MOST_MASK):
            await run_in_thread(_store_mask, coming, path, folder / PAINTED, limits)
        else:
            coming.remove(folder / PAINTED)
    return JSONResponse({})


def _store_mask(coming: Incoming, source: Path, target: Path, limits: Limits) -> None:
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


async def start_task(request: Request) -> Response:
    """Queue a task for a set: the example, the checks, an inference, or an export of a run."""
    session: Session = request.state.session
    name, task = request.path_params["set"], request.path_params["task"]
    if task not in _TASKS:
        raise unknown("task", task, _TASKS)
    asked = await uploads.read_settings(request.stream())
    place = session.find_place(name)  # only now, since it may have been removed meanwhile
    arguments: dict[str, Any] = {"place": str(place)}
    if task == "export":
        number = str(asked.get("run"))[:9]
        if not number.isdecimal() or not (place / "runs" / number / "view" / "view.json").is_file():
            raise InputError(_GONE)
        return queue_task(request, task, number=int(number), name=str(asked.get("name"))[:80], **arguments)
    arguments |= read_answers(asked)
    run = None
    if task == "infer":
        runs = [int(path.name) for path in (place / "runs").glob("*")]
        if len(runs) >= _MOST_RUNS:
            raise InputError(f"a set can have at most {_MOST_RUNS} runs; load the photographs again")
        latest = max(runs, default=0) + 1
        run = place / "runs" / str(latest)
        run.mkdir(parents=True)
        arguments["number"] = latest
    try:
        return queue_task(request, task, **arguments)
    except Refused:
        if run is not None:
            run.rmdir()
        raise


async def send_file(request: Request) -> Response:
    """Send a file of the session's set, and nothing outside it."""
    path = find_file(request.state.session.find_place(request.path_params["set"]), request.path_params["path"])
    if path is None:
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path)


async def send_pixel(request: Request) -> Response:
    """Send the values of one pixel in every photograph, and those of the model."""
    view = _find_run(request) / "view"
    try:
        row, column = (int(request.query_params[key]) for key in ("row", "column"))
    except (KeyError, ValueError) as error:
        raise InputError("row and column: must be numbers inside the picture") from error
    return JSONResponse(replace_nonfinite(await asyncio.to_thread(_read_pixel, view, row, column)))


def _read_pixel(view: Path, row: int, column: int) -> dict[str, list[float]]:
    found = {}
    for name in ("observed", "model"):
        if (view / f"{name}.npy").is_file():
            values = np.load(view / f"{name}.npy", mmap_mode="r")
            if not (0 <= row < values.shape[0] and 0 <= column < values.shape[1]):
                raise InputError("row and column: outside the picture")
            found[name] = np.asarray(values[row, column], np.float64).round(5).tolist()
    return found


async def send_archive(request: Request) -> Response:
    """Send all files that `sdps infer` writes as one ZIP."""
    run = _find_run(request)
    archive = run / "sdps-infer.zip"
    await run_in_thread(pack, run / "files", archive)
    return FileResponse(archive, filename=archive.name)


def _find_run(request: Request) -> Path:
    run = request.state.session.find_place(request.path_params["set"]) / "runs" / str(read_number(request, "run"))
    if not (run / "view" / "view.json").is_file():
        raise InputError(_GONE)
    return run


ROUTES = [
    Route("/sets", make_set, methods=["POST"]),
    Route("/sets/{set}/uploads/{name:path}", upload, methods=["PUT"]),
    Route("/sets/{set}/ball/{ball}/{name:path}", upload, methods=["PUT"]),
    Route("/sets/{set}/mask", upload_mask, methods=["PUT"]),
    Route("/sets/{set}/start/{task}", start_task, methods=["POST"]),
    Route("/sets/{set}/files/{path:path}", send_file),
    Route("/sets/{set}/runs/{run}/pixel", send_pixel),
    Route("/sets/{set}/runs/{run}/download", send_archive),
]
