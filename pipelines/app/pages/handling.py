"""What the request handlers of all pages share: uploads, jobs, a tab's own folder, files below a folder, numbers."""

import asyncio
import functools
import os
import re
import shutil
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from pipelines.app.common.refusals import Refused
from render.shared.errors import InputError

_NUMBER = re.compile(r"[0-9]{1,9}")
_TAB = re.compile(r"[0-9a-f]{0,16}")
_MOST_TABS = 8
_MOST_LEFT = 2**30
_PATIENCE = 60.0
Handler = Callable[[Request], Awaitable[Response]]


def accept_uploads(handler: Handler) -> Handler:
    """Return a handler that reads a body to its end although it refuses it; otherwise the browser, still sending, would
    show a reset connection instead of the reason.
    """

    @functools.wraps(handler)
    async def patient(request: Request) -> Response:
        try:
            return await handler(request)
        except InputError:
            await _read_on(request)
            raise

    return patient


async def _read_on(request: Request) -> None:
    left = _MOST_LEFT
    with suppress(ClientDisconnect, TimeoutError, RuntimeError):  # the last if all of it was read
        async with asyncio.timeout(_PATIENCE):
            async for chunk in request.stream():
                left -= len(chunk)
                if left < 0:
                    return


def queue_task(request: Request, task: str, **arguments: Any) -> Response:
    """Queue a task for a request's session, and return an answer that describes the job.

    Raises:
        Refused: too many jobs are waiting.
    """
    jobs = request.app.state.jobs
    job = jobs.submit(request.state.session.token, task, **arguments)
    if job is None:
        raise Refused("too many jobs are waiting; try again in a minute", 503)
    return JSONResponse(jobs.describe(job))


def find_tab_folder(request: Request, page: str) -> Path:
    """Return the folder of a page's tab, which may not exist yet; each tab has its own, so that scenes do not mix.

    Raises:
        InputError: the tab's name is not valid.
    """
    tab = request.query_params.get("tab", "")
    if not _TAB.fullmatch(tab):
        raise InputError("tab: must be at most 16 hexadecimal digits")
    return request.state.session.folder / f"{page}-{tab}"


def make_tab_folder(request: Request, page: str) -> Path:
    """Return `find_tab_folder`, made if necessary; of too many tabs, those idle for longest lose their folders."""
    folder = find_tab_folder(request, page)
    folder.mkdir(exist_ok=True)
    os.utime(folder)
    others = sorted(folder.parent.glob(f"{page}-*"), key=lambda path: path.stat().st_mtime)
    for old in others[:-_MOST_TABS]:
        if not request.app.state.jobs.works_in(old):
            shutil.rmtree(old, ignore_errors=True)
    return folder


def find_file(folder: Path, name: str) -> Path | None:
    """Return a file below a folder, None if there is none or the name leads out of the folder."""
    try:
        path = (folder / name).resolve()
        return path if path.is_relative_to(folder.resolve()) and path.is_file() else None
    except (OSError, ValueError):  # the name is too long or contains a zero byte
        return None


def read_number(request: Request, key: str) -> int:
    """Return a number from a request's path; -1, which nothing has, for other text and huge numbers."""
    text = request.path_params[key]
    return int(text) if _NUMBER.fullmatch(text) else -1
