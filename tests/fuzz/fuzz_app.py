"""The page of `sdps app` under mutated uploads, requests and folders.

Requests go straight to the application, as a server would pass them on, and jobs run at once in this process. Answers
of 500 and exceptions count as tracebacks; the message of every other refusal is judged as a command's line is.
"""

import asyncio
import json
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import quote_from_bytes, unquote, unquote_to_bytes

import data_folders
import numpy as np
import photo_folders
import sdps_scenes

from render.shared.errors import InputError

HOST = "127.0.0.1:7870"
_MESH = b"OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
_POSE = {"yaw": 10.0, "pitch": 0.0, "roll": -5.5, "bounces": 1, "size": 128}
_PHOTOS = {"gamma": "linear", "lights": True, "frame": "y-up", "anyway": True}
_BALLS = _PHOTOS | {"lights": False, "ball_radius": 5}
_ANSWERS = _PHOTOS | {
    "scale": "1", "flat": "auto", "flatten": "0", "intensities": "", "light_distance": "5", "focal": "50",
    "principal": "12,12", "pixel_size": 0.5, "every": "", "pose": "", "ambient": "none", "dark": "none",
    "balls": [], "ball_alone": None, "ball_radius": "",
}  # fmt: skip
_RUN = "least-squares-run"
_REQUESTS: dict[str, tuple[str, str, Any]] = {
    "check": ("POST", "/photographs/sets/SET/start/check", _PHOTOS),
    "infer": ("POST", "/photographs/sets/SET/start/infer",
              _PHOTOS | {"method": "least-squares", "refine": False, "discontinuities": False}),
    "answers": ("POST", "/photographs/sets/SET/start/check", _ANSWERS),
    "balls": ("POST", "/photographs/sets/SET/start/check", _BALLS | {"balls": ["white:36,12,10.2"]}),
    "alone": ("POST", "/photographs/sets/SET/start/check", _BALLS | {"ball_alone": 1}),
    "ball": ("PUT", "/photographs/sets/SET/ball/1/7.pgm", "P2 4 4 9 " + "1 5 " * 8),
    "export": ("POST", "/photographs/sets/SET/start/export", {"run": 1, "name": "lp"}),
    "relightable": ("POST", "/photographs/sets/SET/start/export", {"run": "1", "name": "ptm"}),
    "upload": ("PUT", "/photographs/sets/SET/uploads/lights.txt", "0 0 1\n0.5 0 0.8\n"),
    "mask": ("PUT", "/photographs/sets/SET/mask", ""),
    "file": ("GET", "/photographs/sets/SET/files/photos/1.png", ""),
    "pixel": ("GET", "/photographs/sets/SET/runs/1/pixel?row=1&column=1", ""),
    "download": ("GET", "/photographs/sets/SET/runs/1/download", ""),
    "scene": ("POST", "/studio/start/scene", {"shape": "sphere", "material": "chrome", "direct": False} | _POSE),
    "preset": ("POST", "/studio/start/preset", {"shape": "blobby:3", "material": "chrome"} | _POSE),
    "mesh": ("PUT", "/studio/uploads/ball.off", _MESH.decode()),
    "kept": ("GET", "/studio/files/scene.zip", ""),
    "list": ("GET", "/data/list", ""),
    "scenes": ("GET", "/data/scenes?folder=.", ""),
    "strip": ("GET", "/data/scene?folder=.&id=sphere-00000", ""),
    "lamp": ("POST", "/data/start?folder=.&id=sphere-00000", {}),
    "curves": ("GET", "/data/curves?folder=.", ""),
    "sections": ("GET", "/data/sections?folder=.", ""),
    "picture": ("GET", "/data/picture?folder=.&section=x&file=a.png", ""),
    "page": ("GET", "/studio", ""),
    "script": ("GET", "/static/jobs.js", ""),
    "job": ("GET", "/jobs/1", ""),
    "cancel": ("POST", "/jobs/1/cancel", {}),
}  # fmt: skip


# --- what is made -------------------------------------------------------------------------------------------------


def requests(folder: Path) -> None:
    """Write a file for every kind of request."""
    from pipelines.app.pages import photo_tasks

    _photographs(folder / "photos", ball=True)
    _ball(folder / "ball")
    place = folder / "made"
    shutil.copytree(folder / "photos", place / "photos")
    photo_tasks.infer(str(place), 1, **_PHOTOS, method="least-squares")
    (place / "runs" / "1").rename(folder / _RUN)
    shutil.rmtree(place)
    room(folder)
    for name, (method, path, body) in _REQUESTS.items():
        headers = {"host": HOST, "origin": f"http://{HOST}", "content-type": "application/json"}
        value = {"method": method, "path": path, "headers": headers, "body": body}
        (folder / f"{name}.http").write_text(json.dumps(value))


def uploads(folder: Path) -> None:
    """Write files that may be uploaded: photographs, masks, archives, lights, meshes and materials.

    A photograph comes to others of its kind, which lie in a folder beside.
    """
    place = folder / "uploads"
    place.mkdir()
    for suffix, bits in ((".png", 8), (".tif", 16), (".jpg", 8), (".exr", 32)):
        photos = folder / suffix[1:]
        _photographs(photos, suffix, bits)
        (photos / f"6{suffix}").rename(place / f"6{suffix}")
    for name in ("mask.png", "light_directions.txt"):
        shutil.copy(folder / "png" / name, place / name)
    whole = folder / "whole"
    _photographs(whole)
    with zipfile.ZipFile(place / "set.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(whole.iterdir()):
            archive.write(path, f"set/{path.name}")
    (whole / "mask.png").unlink()
    (whole / "light_directions.txt").unlink()
    (place / "ball.off").write_bytes(_MESH)
    root = Path(__file__).resolve().parents[2]
    shutil.copy(root / "assets" / "materials" / "chrome.yaml", place / "own.yaml")


def room(folder: Path) -> None:
    """Write what the page Data and runs shows: scenes, a failure, learning curves, a section."""
    folder = folder / "root"
    data_folders.good_folder(folder)
    failed = {"id": "sphere-00000", "seed": 1, "shape": "sphere", "material": "chrome", "reason": "it broke",
              "attempt": 1, "time": "2026-01-01T00:00:00.000+00:00", "traceback": ""}  # fmt: skip
    (folder / "failed.jsonl").write_text(json.dumps(failed) + "\n")
    curves = folder / "models" / "x" / "metrics.jsonl"
    curves.parent.mkdir(parents=True)
    curves.write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "loss": 0.4, "val_mae": 9.5}\n')
    table = {"title": "t", "header": ["a", "b"], "rows": [["x", 1.0]]}
    section = {"name": "x", "order": 1, "title": "t", "text": "a", "tables": [table], "strips": []}
    (folder / "report" / "x").mkdir(parents=True)
    (folder / "report" / "x" / "section.json").write_text(json.dumps(section))
    (folder / "report" / "x" / "a.png").write_bytes(b"")


def _photographs(folder: Path, suffix: str = ".png", bits: int = 8, ball: bool = False) -> None:
    """Write photographs of hills, on request with a white ball to their right, and their lights."""
    lights = data_folders.light_directions(6).astype(float)
    images, mask = photo_folders.matte(lights, size=24)
    images, mask = images[:, 14:38, 14:38], mask[14:38, 14:38]
    if ball:
        images, mask = np.concatenate([images, _shade_ball(lights)], axis=2), np.pad(mask, ((0, 0), (0, 24)))
    photo_folders.write_folder(folder, images, mask, suffix=suffix, bits=bits)
    (folder / "light_directions.txt").write_text("".join("{} {} {}\n".format(*row) for row in lights))


def _ball(folder: Path) -> None:
    """Write photographs of a white ball alone."""
    photo_folders.write_folder(folder, _shade_ball(data_folders.light_directions(6).astype(float)), bits=8)


def _shade_ball(lights: np.ndarray) -> np.ndarray:  # (L, 24, 24, 3)
    normals, mask = sdps_scenes.sphere_normals(24)
    shading = 0.8 * np.maximum(np.einsum("hwc,lc->lhw", normals, lights), 0.0) * mask
    return np.repeat(shading[..., None] + 0.004, 3, axis=-1)


# --- how it is read -----------------------------------------------------------------------------------------------


def read_request(folder: Path, path: Path) -> None:
    """Send a request, mutated as a tree of values; one that is no JSON any more is the body of another."""
    with Page(folder) as page:
        page.photographs(folder / "photos")
        raw = path.read_bytes()
        try:
            value = json.loads(raw)
            method, target, headers = str(value["method"]), str(value["path"]), value["headers"]
            body = value["body"]
            sent = body.encode("utf-8", "replace") if isinstance(body, str) else json.dumps(body).encode()
            names = {str(key): str(item) for key, item in dict(headers).items()}
        except (ValueError, KeyError, TypeError, RecursionError):
            method, target, names, sent = "POST", "/photographs/sets/SET/start/check", {}, raw
        page.send(method, target, sent, names)


def read_upload(folder: Path, path: Path) -> None:
    """Upload a file, also as the picture of a ball alone, and let the checks or the studio read it."""
    with Page(folder) as page:
        alone = path.suffix in (".off", ".yaml", ".zip")
        beside = "whole" if path.stem in ("mask", "light_directions") else path.suffix[1:]
        page.photographs(None if alone else folder / beside)
        if path.suffix in (".off", ".yaml"):
            kind = "shape" if path.suffix == ".off" else "material"
            page.send("PUT", f"/studio/uploads/{path.name}", path.read_bytes())
            page.send("POST", "/studio/start/scene",
                      json.dumps({"shape": "sphere", "material": "chrome", kind: path.name}).encode())  # fmt: skip
            return
        page.send("PUT", f"/photographs/sets/SET/uploads/{path.name}", path.read_bytes())
        if path.name == "mask.png":
            page.send("PUT", "/photographs/sets/SET/mask", path.read_bytes())
        page.send("PUT", f"/photographs/sets/SET/ball/1/{path.name}", path.read_bytes())
        asked = _PHOTOS | {"lights": path.suffix in (".txt", ".zip")}
        page.send("POST", "/photographs/sets/SET/start/check", json.dumps(asked).encode())


def read_room(folder: Path, path: Path) -> None:
    """Look at everything the page Data and runs shows."""
    with Page(folder) as page:
        for name in ("list", "scenes", "strip", "curves", "sections"):
            page.send("GET", _REQUESTS[name][1])


class Page:
    """A browser's session with the application.

    Args:
        folder: Its `root` is what the page Data and runs shows.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        self.temporary = tempfile.TemporaryDirectory(dir=folder)
        self.set = "none"

    def __enter__(self) -> "Page":
        from pipelines.app import server
        from pipelines.app.common.uploads import Limits

        kept = tempfile.tempdir, server.Jobs
        tempfile.tempdir, server.Jobs = self.temporary.name, AtOnce
        try:
            self.app = server.build(self.root, Limits(files=20, bytes=4_000_000, pixels=200_000), HOST)
        finally:
            tempfile.tempdir, server.Jobs = kept
        self.session = self.app.state.sessions.create()
        return self

    def __exit__(self, *_: object) -> None:
        self.app.state.sessions.close()
        self.temporary.cleanup()

    def photographs(self, source: Path | None) -> None:
        """Begin a set with photographs, if there are some, and a finished run."""
        self.set = self.session.make_place()
        place = self.session.folder / self.set
        shutil.copytree(source, place / "photos") if source else (place / "photos").mkdir()
        if (self.root.parent / "ball").is_dir():
            shutil.copytree(self.root.parent / "ball", place / "ball-1")
        self.app.state.jobs.number = 1
        studio = self.session.folder / "studio-"
        studio.mkdir(exist_ok=True)
        (studio / "scene.zip").write_bytes(b"")
        if (self.root.parent / _RUN).is_dir():
            shutil.copytree(self.root.parent / _RUN, place / "runs" / "1")

    def send(self, method: str, target: str, body: bytes = b"", headers: dict[str, str] | None = None) -> None:
        """Send a request; what it is refused with goes to standard error, as a command's line.

        Raises:
            AssertionError: an answer of 500 or more, or a refusal that is none.
        """
        path, _, query = target.replace("SET", self.set).encode("utf-8", "replace").partition(b"?")
        raw = quote_from_bytes(unquote_to_bytes(path)).encode()
        told = {"host": HOST, "origin": f"http://{HOST}"} | (headers or {})
        told["cookie"] = f"sdps-session={self.session.token}"
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method.upper(),
            "scheme": "http", "path": unquote(raw.decode()), "raw_path": raw, "root_path": "",
            "query_string": quote_from_bytes(query, safe="/=&%+").encode(), "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 7870),
            "headers": [(key.lower().encode("latin-1", "replace"), value.encode("latin-1", "replace"))
                        for key, value in told.items()],
        }  # fmt: skip
        status, answer = asyncio.run(self._answer(scope, body))
        assert 200 <= status < 500, (status, answer[:200])
        if status >= 400 and answer.startswith(b"{"):
            sys.stderr.write(f"sdps: {json.loads(answer)['message']}\n")

    async def _answer(self, scope: dict[str, Any], body: bytes) -> tuple[int, bytes]:
        sent: list[dict[str, Any]] = []
        left = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive() -> dict[str, Any]:
            if left:
                return left.pop()
            while not any(message.get("more_body") is False for message in sent[1:]):
                await asyncio.sleep(0.001)
            return {"type": "http.disconnect"}

        async def send(message: dict[str, Any]) -> None:
            sent.append({"more_body": False, **message} if message["type"] == "http.response.body" else message)

        await self.app(scope, receive, send)
        return sent[0]["status"], b"".join(message.get("body", b"") for message in sent[1:])


class AtOnce:
    """In place of the queue: a job runs when it is asked for. Scenes are only planned, not rendered."""

    def __init__(self) -> None:
        self.number = 0

    def submit(self, owner: str, task: str, **arguments: Any) -> int:
        """Run a job; its refusal goes to standard error."""
        from pipelines.app.pages import photo_tasks, run_exports, studio_tasks
        from render.materials import library
        from render.shapes.files.mesh_file import load_mesh

        try:
            if task in ("check", "infer"):
                json.dumps(getattr(photo_tasks, task)(**arguments))
            elif task == "export":
                json.dumps(run_exports.export(**arguments))
            elif task == "shard":
                studio_tasks.prepare_shard(**arguments)
            elif task == "preset":
                studio_tasks.make_training_preset(**arguments)
            elif task in ("scene", "keep"):
                arguments["place"] = Path(arguments["place"])
                spec = studio_tasks.check_choice(**{key: value for key, value in arguments.items() if key != "direct"})
                if Path(spec["shape"]).is_file():
                    load_mesh(Path(spec["shape"]))
                library.load(spec["material"])
        except InputError as error:
            sys.stderr.write(f"sdps: {error}\n")
        self.number += 1
        return self.number

    def describe(self, job: int) -> dict[str, int]:
        """Return its number."""
        return {"id": job}

    def get(self, owner: str, number: int) -> int | None:
        """Return the job of a number."""
        return number if 0 < number <= self.number else None

    def cancel(self, job: int) -> None:
        """It has ended already."""

    def forget(self, owner: str) -> None:
        """Nothing is kept."""
