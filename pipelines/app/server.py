"""The server of `sdps app`: middleware, jobs, and the routes of all pages.

Nothing is loaded from other servers, which the content security policy also forbids. Requests that change something
must come from our own pages, and foreign names for this machine are refused (DNS rebinding).
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
from pipelines.app.common.refusals import Refused, format_size
from pipelines.app.common.sessions import COOKIE, Sessions
from pipelines.app.common.uploads import USABLE, Limits, list_kinds
from pipelines.app.pages import data_routes, photo_routes, studio_routes
from pipelines.app.pages.handling import read_number
from render.shared.errors import InputError
from render.shared.templates import fill

HERE = Path(__file__).parent
PAGES = {"photographs": "Photographs", "studio": "Studio", "data": "Data and runs"}
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
_TIDY = 60.0  # seconds between two clean-ups of sessions
_ANY = ("0.0.0.0", "::")


def build(folder: Path, limits: Limits, host: str = "127.0.0.1") -> Starlette:
    """Return the application; `app.state.close()` ends its worker and removes its temporary folder.

    Args:
        folder: What the page "Data and runs" shows.
        limits: Of uploads.
        host: Address it listens on; requests must name it, unless it means all addresses.
    """
    jobs, sessions = Jobs(), Sessions()

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        tidy = asyncio.create_task(_clean_up(sessions, jobs))
        yield
        tidy.cancel()

    routes = [
        Route("/", lambda _: RedirectResponse("/photographs")),
        Route("/{page:str}", _send_page),
        Route("/jobs/{number}", _send_job),
        Route("/jobs/{number}/cancel", _cancel_job, methods=["POST"]),
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
    """Remove sessions that are no longer used. Their jobs end first, or they would write into removed folders."""
    while True:
        await asyncio.sleep(_TIDY)
        await asyncio.to_thread(sessions.expire, ended=jobs.forget)


def _make_guard(host: str) -> Callable[[Request, Callable[[Request], Awaitable[Response]]], Awaitable[Response]]:
    """Return the middleware that refuses foreign requests, finds the session and sets the headers of every answer."""
    known = {host, "127.0.0.1", "localhost", "[::1]"}

    async def guard(request: Request, proceed: Callable[[Request], Awaitable[Response]]) -> Response:
        named = request.headers.get("host", "")
        name = named.rsplit(":", 1)[0] if not named.endswith("]") else named
        if name not in known and host not in _ANY:
            return JSONResponse({"message": "unknown host name; open the address that `sdps app` printed"}, 403)
        if request.method not in ("GET", "HEAD") and request.headers.get("origin") != f"{request.url.scheme}://{named}":
            return JSONResponse({"message": "requests must come from the app's own pages"}, 403)
        sessions: Sessions = request.app.state.sessions
        session = sessions.find(request.cookies.get(COOKIE))
        page, static = request.url.path.count("/") == 1, request.url.path.startswith("/static/")
        if session is None and not (page or static):
            return JSONResponse({"message": "this page is out of date; load it again"}, 410)
        fresh = sessions.create() if session is None and page else None
        request.state.session = session or fresh
        response = await proceed(request)
        for key, value in _HEADERS.items():
            response.headers.setdefault(key, value)
        if fresh is not None:
            response.set_cookie(COOKIE, fresh.token, httponly=True, samesite="strict")
        return response

    return guard


async def _send_page(request: Request) -> Response:
    """Send a page."""
    name = request.path_params["page"]
    if name not in PAGES:
        return HTMLResponse(fill(HERE / "templates" / "missing.html.j2", pages=PAGES, page=""), 404)
    limits: Limits = request.app.state.limits
    accepted = ",".join((*USABLE, ".zip"))
    template = HERE / "templates" / f"{name}.html.j2"
    return HTMLResponse(
        fill(template, pages=PAGES, page=name, limits=limits, accepted=accepted, kinds=list_kinds(),
             size=format_size(limits.bytes)),
    )  # fmt: skip


async def _send_job(request: Request) -> Response:
    jobs: Jobs = request.app.state.jobs
    job = jobs.get(request.state.session.token, read_number(request, "number"))
    return JSONResponse({"message": "no such job"}, 404) if job is None else JSONResponse(jobs.describe(job))


async def _cancel_job(request: Request) -> Response:
    jobs: Jobs = request.app.state.jobs
    job = jobs.get(request.state.session.token, read_number(request, "number"))
    if job is None:
        return JSONResponse({"message": "no such job"}, 404)
    jobs.cancel(job)
    return JSONResponse(jobs.describe(job))


async def _answer_refusal(_: Request, error: Exception) -> Response:
    """Send the one line of a user's mistake or of a refusal."""
    return JSONResponse({"message": str(error)}, error.status if isinstance(error, Refused) else 400)


async def _end_request(_: Request, error: Exception) -> Response:
    """End the request of a client that disconnected; nobody reads the answer."""
    return Response(status_code=400)
