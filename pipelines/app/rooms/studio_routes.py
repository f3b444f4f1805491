"""The room "Studio": scenes, uploads of meshes and materials, and files to keep."""

import asyncio
import shutil
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.work import uploads
from pipelines.app.work.sessions import Session
from pipelines.app.work.uploads import Limits
from render.shared.errors import InputError, unknown

UPLOADS = "uploads"
MESHES, MATERIALS = (".ply", ".obj", ".stl", ".off", ".glb"), (".yaml", ".yml", ".binary", ".bsdf", ".zip")
_PLACE = "studio"
_ASKED = ("shape", "material", "yaw", "pitch", "roll", "bounces", "size", "direct")
_TASKS = ("gallery", "scene", "keep", "preset")
_MOST = 20


async def start(request: Request) -> Response:
    """Queue a task: the gallery, a scene, its files or a preset of such scenes."""
    session: Session = request.state.session
    task = request.path_params["task"]
    if task not in _TASKS:
        raise unknown("task", task, _TASKS)
    arguments: dict[str, Any] = {}
    if task != "gallery":
        place = session.folder / _PLACE
        place.mkdir(exist_ok=True)
        asked = await uploads.settings(request.stream())
        arguments = {"place": str(place)} | {name: asked[name] for name in _ASKED if name in asked}
        if task != "scene":
            arguments.pop("direct", None)
    job = request.app.state.jobs.submit(session.token, task, **arguments)
    if job is None:
        raise InputError("too many jobs wait; try again in a minute")
    return JSONResponse(request.app.state.jobs.describe(job))


async def upload(request: Request) -> Response:
    """Take a mesh, a material file, or a ZIP of PBR maps, which becomes a folder."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    folder = session.folder / UPLOADS
    folder.mkdir(exist_ok=True)
    name = uploads.safe_name(request.path_params["name"], MESHES + MATERIALS)
    if len(list(folder.iterdir())) >= _MOST:
        raise InputError(f"more than {_MOST} files; load the page anew")
    room = limits.bytes - session.taken
    if name.lower().endswith(".zip"):
        name = Path(name).stem
        place, incoming = folder / name, session.folder / f"{_PLACE}.zip"
        for old in (place, incoming):
            await asyncio.to_thread(_remove, old)
        place.mkdir()
        try:
            session.taken += await uploads.receive_archive(request.stream(), incoming, place, limits, room)
        except BaseException:
            shutil.rmtree(place, ignore_errors=True)
            raise
    else:
        await asyncio.to_thread(_remove, folder / name)
        session.taken += await uploads.receive(request.stream(), folder / name, room)
    return JSONResponse({"name": name})


def _remove(path: Path) -> None:
    """Remove a file, or a folder of maps, of an earlier upload."""
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


async def file(request: Request) -> Response:
    """Send what was made of the last scene."""
    name = request.path_params["name"]
    path = request.state.session.folder / _PLACE / name
    if name not in ("basis.bin", "truth.bin", "direct.bin", "scene.zip") or not path.is_file():
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path, filename=name if name.endswith(".zip") else None)


ROUTES = [
    Route("/start/{task}", start, methods=["POST"]),
    Route("/uploads/{name}", upload, methods=["PUT"]),
    Route("/files/{name}", file),
]
