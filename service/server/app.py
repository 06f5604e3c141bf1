"""The server as an ASGI application: routes behind the guard, and one sentence for whatever goes wrong."""

from __future__ import annotations

import logging
from http import HTTPStatus
from importlib import metadata
from pathlib import Path

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from t6gps.service.driving.drives import Drives
from t6gps.service.monitoring import exporter
from t6gps.service.monitoring.exporter import Exporter
from t6gps.service.page import files as page
from t6gps.service.remote.messages import Health
from t6gps.service.server.guard import Clock, Guard, Limits, refusal, utc_now
from t6gps.service.server.launching import Launch, launch
from t6gps.service.server.routes import administering, driving, jobs, operating, reading, stored
from t6gps.service.server.routes.access import REFUSALS, Answers, NoSuchRunError, Reading, Served, Slots
from t6gps.service.server.tokens import Verifier
from t6gps.storage.errors import ConfigError, QueryError, RunError, ServerError, T6GpsError

LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
DEFAULT_LIMITS = Limits()
SCRAPES_N = 4
"""Scrapes that may wait for each other; who comes then is told to come back."""
_log = logging.getLogger(__name__)


def create(
    root: Path,
    names: frozenset[str] = LOOPBACK,
    scheme: str = "http",
    start: Launch = launch,
    now: Clock = utc_now,
    limits: Limits = DEFAULT_LIMITS,
) -> FastAPI:
    """The application for the runs of a root.

    names    names of this server that a client may ask for
    start    what lets a job train a run
    now      the time by which tokens expire
    """
    version = metadata.version("t6gps")
    app = FastAPI(title="t6gps", version=version, docs_url=None, redoc_url=None, redirect_slashes=False)
    known = Verifier(root)
    app.state.served = Served(
        root, start, limits.query_s, Drives(limits.drives), lambda token: known.holds(token, now())
    )
    app.add_middleware(Guard, root=root, names=names, scheme=scheme, now=now, limits=limits)
    for routes in (
        reading.routes,
        stored.routes,
        stored.asking,
        jobs.routes,
        operating.routes,
        driving.routes,
        administering.routes,
        _monitoring(root),
        page.routes(),
    ):
        app.include_router(routes)

    @app.get("/v1/health", tags=["read"])
    async def health() -> Health:
        """The server is alive; this needs no token."""
        return Health(version=version)

    app.add_exception_handler(T6GpsError, _refused)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(RequestValidationError, _refused)
    app.add_exception_handler(OSError, _refused)
    app.add_exception_handler(Exception, _broken)
    return app


def _monitoring(root: Path) -> APIRouter:
    """The route for Prometheus, which knows it by this path."""
    routes, known, slots = APIRouter(responses=REFUSALS, tags=["read"]), Exporter(root), Slots(SCRAPES_N)
    answers: Answers = {200: {"content": {"text/plain": {}}, "description": "Metrics as text."}}

    @routes.get("/metrics", dependencies=[Reading], response_class=Response, responses=answers)
    def metrics() -> Response:
        """How the server and the runs are, for Prometheus."""
        with slots.taken():
            return Response(known.text(), media_type=exporter.CONTENT_TYPE)

    return routes


def _refused(request: Request, error: Exception) -> Response:
    """One sentence. What the server's own system refuses is said in its log, and not to strangers."""
    if isinstance(error, RequestValidationError):
        return refusal(HTTPStatus.UNPROCESSABLE_ENTITY, _sentence(error), ServerError)
    if isinstance(error, HTTPException):
        return refusal(error.status_code, str(error.detail), ServerError, error.headers)
    if isinstance(error, NoSuchRunError):
        return refusal(HTTPStatus.NOT_FOUND, str(error), RunError)
    if isinstance(error, ConfigError | QueryError):
        return refusal(HTTPStatus.BAD_REQUEST, str(error), type(error))
    if isinstance(error, T6GpsError):
        return refusal(HTTPStatus.CONFLICT, str(error), type(error))
    _log.error("%s %s: %s", request.method, request.url.path, error)
    sentence = "the server's system refused; see the server's log, make room or give access, and ask again"
    return refusal(HTTPStatus.SERVICE_UNAVAILABLE, sentence, ServerError)


def _broken(request: Request, error: Exception) -> Response:
    """A fault of ours: its traceback goes to the log alone."""
    sentence = "the server has made a mistake, which stands in its log; report it"
    return refusal(HTTPStatus.INTERNAL_SERVER_ERROR, sentence, ServerError)


def _sentence(error: RequestValidationError) -> str:
    """Where the request is wrong, and how."""
    faults = [f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
    return f"the request is not as the document has it: {'; '.join(faults)}; correct it"
