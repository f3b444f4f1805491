"""The server of `sdps app`: middleware, what all rooms share, and the rooms' routes.

Nothing is fetched from elsewhere, which the content security policy also forbids. Requests that change something must
come from our own pages, and a foreign name for this machine is refused (DNS rebinding).
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from pipelines.app.common.jobs import Jobs
from pipelines.app.common.refusals import Refused
from pipelines.app.common.sessions import COOKIE, Sessions
from pipelines.app.common.uploads import BESIDE, PICTURES, Limits, list_kinds
from pipelines.app.pages import data_routes, photo_routes, studio_routes
from pipelines.app.pages.handling import read_number
from render.shared.errors import InputError
from render.shared.templates import fill

HERE = Path(__file__).parent
ROOMS = {"photographs": "Photographs", "studio": "Studio", "data": "Data and runs"}
_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; connect-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_TIDY = 60.0  # seconds between two looks for sessions that ended
_ANY = ("0.0.0.0", "::")


def build(folder: Path, limits: Limits, host: str = "127.0.0.1") -> Starlette:
    """Return the application; `app.state.close()` ends its worker and removes its temporary folder.

    Args:
        folder: What the room "Data and runs" shows.
        limits: Of uploads.
        host: Address it listens on; requests must name it, unless it stands for all addresses.
    """
    jobs, sessions = Jobs(), Sessions()

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        tidy = asyncio.create_task(_clean_up(sessions, jobs))
        yield
        tidy.cancel()

    routes = [
        Route("/", lambda _: RedirectResponse("/photographs")),
        Route("/{room:str}", _page),
        Route("/jobs/{number}", _job),
        Route("/jobs/{number}/cancel", _cancel, methods=["POST"]),
        Mount("/photographs", routes=photo_routes.ROUTES),
        Mount("/studio", routes=studio_routes.ROUTES),
        Mount("/data", routes=data_routes.ROUTES),
        Mount("/static", StaticFiles(directory=HERE / "static")),
    ]
    app = Starlette(
        routes=routes,
        middleware=[
            Middleware(BaseHTTPMiddleware, dispatch=_make_guard(host)),
        ],
        exception_handlers={InputError: _answer_refusal, ClientDisconnect: _end_request},
        lifespan=lifespan,
    )
    app.state.reading = asyncio.Semaphore(2)  # scenes at a time
    app.state.jobs, app.state.sessions, app.state.limits, app.state.folder = jobs, sessions, limits, folder

    def close() -> None:
        jobs.close()
        sessions.close()

    app.state.close = close
    return app


async def _clean_up(sessions: Sessions, jobs: Jobs) -> None:
    """Remove sessions that nobody uses any more. Their jobs end first, or would write into folders that are gone."""
    while True:
        await asyncio.sleep(_TIDY)
        await asyncio.to_thread(sessions.expire, ended=jobs.forget)


def _make_guard(host: str) -> Callable[[Request, Callable[[Request], Awaitable[Response]]], Awaitable[Response]]:
    """Return what refuses foreign requests, finds the session, and sets the headers of every answer."""
    known = {host, "127.0.0.1", "localhost", "[::1]"}

    async def guard(request: Request, proceed: Callable[[Request], Awaitable[Response]]) -> Response:
        named = request.headers.get("host", "")
        name = named.rsplit(":", 1)[0] if not named.endswith("]") else named
        if name not in known and host not in _ANY:
            return JSONResponse({"message": "this name does not belong to this page"}, 403)
        if request.method not in ("GET", "HEAD") and request.headers.get("origin") != f"{request.url.scheme}://{named}":
            return JSONResponse({"message": "requests must come from this page"}, 403)
        sessions: Sessions = request.app.state.sessions
        session = sessions.find(request.cookies.get(COOKIE))
        page, static = request.url.path.count("/") == 1, request.url.path.startswith("/static/")
        if session is None and not (page or static):
            return JSONResponse({"message": "this page is too old; load it again"}, 410)
        fresh = sessions.create() if session is None and page else None
        request.state.session = session or fresh
        response = await proceed(request)
        for key, value in _HEADERS.items():
            response.headers.setdefault(key, value)
        if fresh is not None:
            response.set_cookie(COOKIE, fresh.token, httponly=True, samesite="strict")
        return response

    return guard


async def _page(request: Request) -> Response:
    """Return the page of a room."""
    room = request.path_params["room"]
    if room not in ROOMS:
        return HTMLResponse(fill(HERE / "templates" / "missing.html.j2", rooms=ROOMS, room=""), 404)
    limits: Limits = request.app.state.limits
    accepted = ",".join((*PICTURES, *BESIDE, ".zip"))
    template = HERE / "templates" / f"{room}.html.j2"
    return HTMLResponse(
        fill(template, rooms=ROOMS, room=room, limits=limits, accepted=accepted, kinds=list_kinds()),
    )  # fmt: skip


async def _job(request: Request) -> Response:
    jobs: Jobs = request.app.state.jobs
    job = jobs.get(request.state.session.token, read_number(request, "number"))
    return JSONResponse({"message": "no such job"}, 404) if job is None else JSONResponse(jobs.describe(job))


async def _cancel(request: Request) -> Response:
    jobs: Jobs = request.app.state.jobs
    job = jobs.get(request.state.session.token, read_number(request, "number"))
    if job is None:
        return JSONResponse({"message": "no such job"}, 404)
    jobs.cancel(job)
    return JSONResponse(jobs.describe(job))


async def _answer_refusal(_: Request, error: Exception) -> Response:
    """Answer a mistake of the user, or what the server refuses, with its one line."""
    return JSONResponse({"message": str(error)}, error.status if isinstance(error, Refused) else 400)


async def _end_request(_: Request, error: Exception) -> Response:
    """End the request of somebody who went away in the middle of it; nobody reads the answer."""
    return Response(status_code=400)
