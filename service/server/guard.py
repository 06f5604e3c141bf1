"""What stands before every route: names of the server, origins, tokens, rates, sizes, and bodies that do not come.

A request is refused before anything of its body is read.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import final

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from t6gps.service.driving.drive import Patience
from t6gps.service.page.files import is_of_page
from t6gps.service.remote.messages import AuditLine
from t6gps.service.server import audit
from t6gps.service.server.rates import Rates
from t6gps.service.server.tokens import RefusedTokenError, Token, Verifier
from t6gps.storage.errors import ServerError

OPEN = ("/v1/health", "/openapi.json")
"""Paths that need no token, like those of the page: they say nothing of any run."""
SENTENCE_LENGTH_N = 10_000
_log = logging.getLogger(__name__)
Clock = Callable[[], datetime]


@dataclass(frozen=True)
class Limits:
    """Bounds on what clients may do.

    body_bytes_n   of a request
    stalled_s      without a byte of a body
    requests       of one token: each second, and at once
    failures       of one address without a valid token: each second, and at once
    query_s        that a query may take
    drives         how long somebody may drive a policy
    """

    body_bytes_n: int = 2**20
    stalled_s: float = 30.0
    requests: tuple[float, int] = (200.0, 400)
    failures: tuple[float, int] = (1.0, 20)
    query_s: float = 30.0
    drives: Patience = field(default_factory=Patience)


def utc_now() -> datetime:
    """The time by which tokens expire."""
    return datetime.now(UTC)


def refusal(
    status: int, sentence: str, kind: type[Exception], headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """An answer that refuses, with the reason as `messages.Refusal`."""
    safe = sentence[:SENTENCE_LENGTH_N].encode(errors="backslashreplace").decode()  # it may repeat what was asked
    return JSONResponse({"error": safe, "kind": kind.__name__}, status, dict(headers or {}))


@final
class Guard:
    """Lets those requests through to `app` that it may answer, and notes changes in the audit."""

    def __init__(
        self,
        app: ASGIApp,
        root: Path,
        names: frozenset[str],
        scheme: str,
        now: Clock,
        limits: Limits,
    ) -> None:
        self._app, self._root, self._names, self._scheme, self._now = app, root, names, scheme, now
        self._limits, self._verifier = limits, Verifier(root)
        self._requests, self._failures = Rates(*limits.requests), Rates(*limits.failures)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or have it answered."""
        if scope["type"] != "http":
            raise ServerError(f"only HTTP is spoken here, found {scope['type']}")
        state = scope.setdefault("state", {})
        try:
            self._check_names(Headers(scope=scope))
            if scope["path"] not in OPEN and not is_of_page(scope["path"]):
                state["token"] = self._check_token(scope)
            receive = _bounded(Headers(scope=scope), receive, self._limits)
            await self._app(scope, receive, self._sending(scope, send))
        except HTTPException as error:
            await refusal(error.status_code, str(error.detail), ServerError, error.headers)(scope, receive, send)

    def _check_names(self, headers: Headers) -> None:
        """Who was led here by another name, or by a page of another server, is refused."""
        host = headers.get("host", "")
        if _without_port(host) not in self._names:
            names = ", ".join(sorted(self._names))
            raise HTTPException(HTTPStatus.BAD_REQUEST, f"Host {host[:100]!r} is none of this server's names: {names}")
        origin = headers.get("origin")
        if origin is not None and origin != f"{self._scheme}://{host}":
            sentence = f"Origin {origin[:100]!r} may not ask here; only pages of this server may"
            raise HTTPException(HTTPStatus.FORBIDDEN, sentence)

    def _check_token(self, scope: Scope) -> Token:
        kind, _, text = Headers(scope=scope).get("authorization", "").partition(" ")
        try:
            if kind.lower() != "bearer" or not text:
                raise RefusedTokenError("a token is needed: set T6GPS_TOKEN, or send Authorization: Bearer TOKEN")
            token = self._verifier.verify(text.strip(), self._now())
        except RefusedTokenError as error:
            _wait(self._failures.take(_address(scope), time.monotonic()))
            challenge = {"WWW-Authenticate": "Bearer"}
            raise HTTPException(HTTPStatus.UNAUTHORIZED, str(error), challenge) from None
        except ServerError as error:
            _log.error("%s", error)
            sentence = "the server cannot read its tokens; see its log"
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, sentence) from None
        _wait(self._requests.take(token.id, time.monotonic()))
        return token

    def _sending(self, scope: Scope, send: Send) -> Send:
        """Sends an answer, and notes that to a change before."""

        async def sending(message: Message) -> None:
            state = scope["state"]
            if message["type"] == "http.response.start" and "change" in state:
                audit.write(self._root, self._line(scope, message["status"]))
            await send(message)

        return sending

    def _line(self, scope: Scope, status: int) -> AuditLine:
        state = scope["state"]
        return AuditLine(
            time=self._now(),
            token=state["token"].name,
            address=_address(scope),
            method=scope["method"],
            path=scope["path"],
            details=state["change"],
            status=status,
        )


def _bounded(headers: Headers, receive: Receive, limits: Limits) -> Callable[[], Awaitable[Message]]:
    """Receives a body that is not too large, from a client that goes on sending."""
    said = headers.get("content-length", "0")
    if said.isdecimal() and int(said) > limits.body_bytes_n:
        raise _too_large(said, limits)
    taken_n, complete = 0, False

    async def receiving() -> Message:
        nonlocal taken_n, complete
        if complete:  # what comes now is that the client goes, whenever it likes
            return await receive()
        try:
            async with asyncio.timeout(limits.stalled_s):
                message = await receive()
        except TimeoutError:
            raise HTTPException(
                HTTPStatus.REQUEST_TIMEOUT, f"the body did not come within {limits.stalled_s:.0f} s"
            ) from None
        taken_n += len(message.get("body", b""))
        if taken_n > limits.body_bytes_n:
            raise _too_large(taken_n, limits)
        complete = not message.get("more_body", False)
        return message

    return receiving


def _too_large(size: object, limits: Limits) -> HTTPException:
    sentence = f"the body has {size} bytes or more; at most {limits.body_bytes_n} are taken"
    return HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, sentence)


def _wait(seconds: int) -> None:
    if seconds:
        sentence = f"too many requests; ask again after {seconds} s"
        raise HTTPException(HTTPStatus.TOO_MANY_REQUESTS, sentence, {"Retry-After": str(math.ceil(seconds))})


def _without_port(host: str) -> str:
    """The name in a Host header: that of an IPv6 address is in brackets."""
    name, colon, port = host.rpartition(":")
    return (name if colon and (port.isdecimal() or not port) else host).lower()


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return str(client[0]) if client else "unknown"
