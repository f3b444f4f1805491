"""The page "Studio": scenes, uploads of meshes and materials, and files to keep."""

from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from pipelines.app.common import uploads
from pipelines.app.common.archives import unpack
from pipelines.app.common.incoming import Incoming, open_upload, receive, run_in_thread
from pipelines.app.common.sessions import Session
from pipelines.app.common.uploads import Limits
from pipelines.app.pages.handling import accept_uploads, find_tab_folder, make_tab_folder, queue_task
from render.shared.errors import unknown

UPLOADS = "uploads"
MESHES, MATERIALS = (".ply", ".obj", ".stl", ".off", ".glb"), (".yaml", ".yml", ".binary", ".bsdf", ".zip")
_PAGE = "studio"
_ASKED = ("shape", "material", "yaw", "pitch", "roll", "bounces", "size", "direct")
_TASKS = ("gallery", "scene", "keep", "preset")
_MOST = 20


async def start_task(request: Request) -> Response:
    """Queue a task: the gallery, a scene, its files or a preset of such scenes."""
    task = request.path_params["task"]
    if task not in _TASKS:
        raise unknown("task", task, _TASKS)
    arguments: dict[str, Any] = {}
    if task != "gallery":
        asked = await uploads.read_settings(request.stream())
        place = make_tab_folder(request, _PAGE)
        arguments = {"place": str(place)} | {name: asked[name] for name in _ASKED if name in asked}
        if task != "scene":
            arguments.pop("direct", None)
    return queue_task(request, task, **arguments)


@accept_uploads
async def upload(request: Request) -> Response:
    """Receive a mesh, a material file, or a ZIP of PBR maps, which becomes a folder."""
    session: Session = request.state.session
    limits: Limits = request.app.state.limits
    folder = session.folder / UPLOADS
    folder.mkdir(exist_ok=True)
    given = uploads.clean_name(request.path_params["name"], MESHES + MATERIALS)
    name = Path(given).stem if given.lower().endswith(".zip") else given
    async with open_upload(session, limits.bytes, f"{UPLOADS}/{name}") as coming:
        path = coming.folder / given
        await receive(request.stream(), path, coming, uploads.most_bytes(given))
        await run_in_thread(_accept, coming, path, folder / name, limits)
    return JSONResponse({"name": name})


def _accept(coming: Incoming, path: Path, target: Path, limits: Limits) -> None:
    """Move an upload to where the studio looks for it, replacing what has the same name."""
    if path.suffix.lower() == ".zip":
        archive, path = path, coming.folder / "maps"
        unpack(archive, path, limits, coming)
    coming.put(path, target, _MOST)


async def send_file(request: Request) -> Response:
    """Send a file of the tab's last scene."""
    name = request.path_params["name"]
    path = find_tab_folder(request, _PAGE) / name
    if name not in ("basis.bin", "truth.bin", "direct.bin", "scene.zip") or not path.is_file():
        return JSONResponse({"message": "no such file"}, 404)
    return FileResponse(path, filename=name if name.endswith(".zip") else None)


ROUTES = [
    Route("/start/{task}", start_task, methods=["POST"]),
    Route("/uploads/{name}", upload, methods=["PUT"]),
    Route("/files/{name}", send_file),
]
