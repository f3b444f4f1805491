"""What the request handlers of all rooms share: uploads, queueing a job, files below a folder, numbers in a path."""

import asyncio
import functools
import re
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from pipelines.app.work.refusals import Refused
from render.shared.errors import InputError

_NUMBER = re.compile(r"[0-9]{1,9}")
_MOST_LEFT = 2**30
_PATIENCE = 60.0
Handler = Callable[[Request], Awaitable[Response]]


def taking_uploads(handler: Handler) -> Handler:
    """Return a handler that reads on to the end of a body it refuses; else the browser, which is still sending, would
    show a connection that was reset in place of the reason.
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
    with suppress(ClientDisconnect, TimeoutError, RuntimeError):  # the last where all of it was read
        async with asyncio.timeout(_PATIENCE):
            async for chunk in request.stream():
                left -= len(chunk)
                if left < 0:
                    return


def queued(request: Request, task: str, **arguments: Any) -> Response:
    """Queue a task for a request's session, and return the answer that describes it.

    Raises:
        Refused: too many jobs wait.
    """
    jobs = request.app.state.jobs
    job = jobs.submit(request.state.session.token, task, **arguments)
    if job is None:
        raise Refused("too many jobs wait; try again in a minute", 503)
    return JSONResponse(jobs.describe(job))


def file_inside(folder: Path, name: str) -> Path | None:
    """Return a file below a folder, None where there is none or the name leads out of it."""
    try:
        path = (folder / name).resolve()
        return path if path.is_relative_to(folder.resolve()) and path.is_file() else None
    except (OSError, ValueError):  # too long a name, or one with a zero
        return None


def number(request: Request, key: str) -> int:
    """Return a number of a request's path; -1, which nothing has, for other text and numbers without end."""
    text = request.path_params[key]
    return int(text) if _NUMBER.fullmatch(text) else -1
