"""What stands before every route: names of the server, origins, tokens, rates, sizes, and clients that stand still.

A request is refused before anything of its body is read. A client that neither sends nor takes anything for STALLED_S
is dropped, wherever it is in a stream, and holds up nobody meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import final

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from t6gps.service.remote.messages import AuditLine
from t6gps.service.server import audit
from t6gps.service.server.rates import Rates
from t6gps.service.server.tokens import Token, Verifier
from t6gps.storage.errors import ServerError

OPEN = ("/v1/health", "/openapi.json")
"""Paths that need no token: they say nothing of any run."""
BODY_BYTES_N = 2**20
SENTENCE_LENGTH_N = 10_000
STALLED_S = 30.0
REQUESTS_PER_S, REQUESTS_BURST_N = 200.0, 400
FAILURES_PER_S, FAILURES_BURST_N = 1.0, 20
_log = logging.getLogger(__name__)
Clock = Callable[[], datetime]


def utc_now() -> datetime:
    """The time by which tokens expire."""
    return datetime.now(UTC)


class _Refused(Exception):
    def __init__(self, status: HTTPStatus, sentence: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(sentence)
        self.status, self.headers = status, headers


class _Stalled(Exception):
    pass


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
        now: Clock = utc_now,
        stalled_s: float = STALLED_S,
        rates: tuple[Rates, Rates] | None = None,
    ) -> None:
        self._app, self._root, self._names, self._scheme, self._now = app, root, names, scheme, now
        self._stalled_s, self._verifier = stalled_s, Verifier(root)
        self._requests, self._failures = rates or (
            Rates(REQUESTS_PER_S, REQUESTS_BURST_N),
            Rates(FAILURES_PER_S, FAILURES_BURST_N),
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or have it answered."""
        if scope["type"] != "http":
            raise ServerError(f"only HTTP is spoken here, found {scope['type']}")
        state = scope.setdefault("state", {})
        try:
            self._check_names(Headers(scope=scope))
            if scope["path"] not in OPEN:
                state["token"] = self._check_token(scope)
            receive = _bounded(Headers(scope=scope), receive, self._stalled_s)
            await self._app(scope, receive, self._sending(scope, send))
        except _Refused as error:
            await refusal(error.status, str(error), ServerError, error.headers)(scope, receive, send)
        except _Stalled:
            _log.info("%s has stood still for %.0f s and is dropped", _address(scope), self._stalled_s)

    def _check_names(self, headers: Headers) -> None:
        """Who was led here by another name, or by a page of another server, is refused."""
        host = headers.get("host", "")
        if _without_port(host) not in self._names:
            names = ", ".join(sorted(self._names))
            raise _Refused(HTTPStatus.BAD_REQUEST, f"Host {host[:100]!r} is none of this server's names: {names}")
        origin = headers.get("origin")
        if origin is not None and origin != f"{self._scheme}://{host}":
            sentence = f"Origin {origin[:100]!r} may not ask here; only pages of this server may"
            raise _Refused(HTTPStatus.FORBIDDEN, sentence)

    def _check_token(self, scope: Scope) -> Token:
        kind, _, text = Headers(scope=scope).get("authorization", "").partition(" ")
        try:
            if kind.lower() != "bearer" or not text:
                raise ServerError("a token is needed: set T6GPS_TOKEN, or send Authorization: Bearer TOKEN")
            token = self._verifier.verify(text.strip(), self._now())
        except ServerError as error:
            _wait(self._failures.take(_address(scope), time.monotonic()))
            challenge = {"WWW-Authenticate": "Bearer"}
            raise _Refused(HTTPStatus.UNAUTHORIZED, str(error), challenge) from None
        _wait(self._requests.take(token.id, time.monotonic()))
        return token

    def _sending(self, scope: Scope, send: Send) -> Send:
        """Sends parts of an answer to who takes them, and notes the answer to a change before it is given."""

        async def sending(message: Message) -> None:
            state = scope["state"]
            if message["type"] == "http.response.start" and "change" in state:
                audit.write(self._root, self._line(scope, message["status"]))
            try:
                async with asyncio.timeout(self._stalled_s):
                    await send(message)
            except TimeoutError:
                raise _Stalled from None

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


def _bounded(headers: Headers, receive: Receive, stalled_s: float) -> Callable[[], Awaitable[Message]]:
    """Receives a body of at most BODY_BYTES_N, from a client that goes on sending."""
    said = headers.get("content-length", "0")
    if said.isdecimal() and int(said) > BODY_BYTES_N:
        raise _too_large(said)
    taken_n, complete = 0, False

    async def receiving() -> Message:
        nonlocal taken_n, complete
        if complete:  # what comes now is that the client goes, whenever it likes
            return await receive()
        try:
            async with asyncio.timeout(stalled_s):
                message = await receive()
        except TimeoutError:
            raise _Refused(HTTPStatus.REQUEST_TIMEOUT, f"the body did not come within {stalled_s:.0f} s") from None
        taken_n += len(message.get("body", b""))
        if taken_n > BODY_BYTES_N:
            raise _too_large(taken_n)
        complete = not message.get("more_body", False)
        return message

    return receiving


def _too_large(size: object) -> _Refused:
    sentence = f"the body has {size} bytes or more; at most {BODY_BYTES_N} are taken"
    return _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, sentence)


def _wait(seconds: int) -> None:
    if seconds:
        sentence = f"too many requests; ask again after {seconds} s"
        raise _Refused(HTTPStatus.TOO_MANY_REQUESTS, sentence, {"Retry-After": str(math.ceil(seconds))})


def _without_port(host: str) -> str:
    """The name in a Host header: that of an IPv6 address is in brackets."""
    name, colon, port = host.rpartition(":")
    return (name if colon and (port.isdecimal() or not port) else host).lower()


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return str(client[0]) if client else "unknown"
