"""A server of `sdps app` in a thread, and a plain client of it."""

import http.client
import http.cookiejar
import json
import os
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def serving(folder: Path, **limits: int) -> Iterator[str]:
    """Serve on a free port; yield the address without the last slash."""
    with application(folder, **limits) as (address, _):
        yield address


@contextmanager
def application(folder: Path, **limits: int) -> Iterator[tuple[str, Any]]:
    """Serve on a free port; yield the address and the application."""
    import uvicorn

    from pipelines.app.common.uploads import Limits
    from pipelines.app.server import build

    app = build(folder, Limits(**limits))
    config = uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning")
    socket = config.bind_socket()
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [socket]}, daemon=True)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        yield f"http://127.0.0.1:{socket.getsockname()[1]}", app
    finally:
        server.should_exit = True
        thread.join(10)
        app.state.close()
        assert not app.state.sessions.folder.exists()


def eventually(holds: Callable[[], bool], seconds: float = 10.0) -> bool:
    """Tell whether something comes true within a time."""
    until = time.monotonic() + seconds
    while not (now := holds()) and time.monotonic() < until:
        time.sleep(0.01)
    return now


def contents(folder: Path) -> dict[str, int]:
    """Return the files below a folder, by their paths, and their sizes; some may go meanwhile."""
    found = {}
    for place, _, names in os.walk(folder):
        for path in (Path(place) / name for name in names):
            with suppress(OSError):
                found[str(path.relative_to(folder))] = path.lstat().st_size
    return found


class Client:
    """A browser's requests: it keeps its cookie and names its origin."""

    def __init__(self, address: str, page: str = "photographs") -> None:
        self.address, self.origin = address, address
        self.cookies = http.cookiejar.CookieJar()
        self.opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(self.cookies))
        self.get(f"/{page}")

    @property
    def token(self) -> str:
        """The name of the session, as `Sessions.find` takes it."""
        return next(iter(self.cookies)).value

    def send(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
        """Return status and body."""
        request = urllib.request.Request(self.address + path, body, {"Origin": self.origin, **headers}, method=method)
        try:
            with self.opener.open(request, timeout=60) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    def get(self, path: str) -> bytes:
        """Return the body of what must be there."""
        status, body = self.send("GET", path)
        assert status == 200, (path, status, body[:300])
        return body

    def post(self, path: str, value: Any = None) -> Any:
        """Return the JSON of an answer that must be good."""
        status, body = self.send("POST", path, json.dumps(value or {}).encode())
        assert status == 200, (path, status, body)
        return json.loads(body)

    def new_set(self, folder: Path | None = None) -> str:
        """Begin a set, upload the files of a folder, and return the set's path."""
        path = f"/photographs/sets/{self.post('/photographs/sets')['set']}"
        for file in sorted(folder.iterdir()) if folder else []:
            status, body = self.send("PUT", f"{path}/uploads/{file.name}", file.read_bytes())
            assert status == 200, body
        return path

    def begin(self, path: str, size: int) -> http.client.HTTPConnection:
        """Send the head of an upload of `size` bytes; the caller sends the body, or goes away in the middle of it."""
        connection = http.client.HTTPConnection(self.address.removeprefix("http://"), timeout=60)
        connection.putrequest("PUT", path)
        headers = {"Content-Length": str(size), "Origin": self.origin, "Cookie": f"sdps-session={self.token}"}
        for key, value in headers.items():
            connection.putheader(key, value)
        connection.endheaders()
        return connection

    def wait(self, job: dict[str, Any], seconds: float = 120.0) -> dict[str, Any]:
        """Return the last state of a job."""
        until = time.monotonic() + seconds
        while job["state"] in ("queued", "running"):
            assert time.monotonic() < until, job
            time.sleep(0.05)
            job = json.loads(self.get(f"/jobs/{job['id']}"))
        return job
