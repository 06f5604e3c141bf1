"""A connection to a server: what is asked and answered, checked at both ends.

The token is sent over TLS, or to this machine alone. Certificates are checked by the authorities of the system, or
those of SSL_CERT_FILE.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TypeVar, final

import httpx
import pyarrow as pa
from pydantic import BaseModel, JsonValue, TypeAdapter, ValidationError

from t6gps.service.remote.messages import WAIT_S, WARNINGS, Refusal
from t6gps.service.remote.stream import REFUSED, Update, parsed
from t6gps.storage.errors import (
    CheckpointError,
    ConfigError,
    DataError,
    QueryError,
    RunError,
    ServerError,
    T6GpsError,
    TerrainError,
)

KINDS: dict[str, type[T6GpsError]] = {
    kind.__name__: kind for kind in (ConfigError, RunError, DataError, CheckpointError, QueryError, TerrainError)
}
"""Errors that a server may tell, by their names; any other is a ServerError."""
ANSWER_S, CONNECT_S = 3 * WAIT_S, 10.0
"""A server that says nothing for so long is said to be silent."""
BUSY_S, SHORTEST_WAIT_S = WAIT_S, 0.1
"""For so long a server that is busy is asked again, and at most so often."""
T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)


class UnreachableError(ServerError):
    """A server that cannot be reached, or with which the connection has broken."""


@final
class Connection:
    """Asks a server with a token. ServerError where it cannot be reached or refuses, else the error that it tells."""

    def __init__(self, url: str, token: str, transport: httpx.BaseTransport | None = None) -> None:
        self.url = _checked(url)
        if not token or not token.isascii() or not token.isprintable() or " " in token:
            raise ServerError(f"server {url} needs a token; set T6GPS_TOKEN to what t6gps token create printed")
        self._http = httpx.Client(
            base_url=f"{self.url}/v1",
            headers={"Authorization": f"Bearer {token}"},
            timeout=httpx.Timeout(ANSWER_S, connect=CONNECT_S),
            trust_env=self.url.startswith("https"),  # else a proxy of the environment would see the token
            transport=transport,
        )

    def close(self) -> None:
        """Close it."""
        self._http.close()

    def get(self, path: str, kind: type[T]) -> T:
        """What is there, as an object of a kind."""
        return self.read(self.ask("GET", path), kind)

    def post(self, path: str, kind: type[T], request: BaseModel | None = None) -> T:
        """What the server makes of a request, as an object of a kind."""
        return self.read(self.ask("POST", path, request), kind)

    def ask(self, method: str, path: str, request: BaseModel | None = None) -> bytes:
        """The body of an answer."""
        body = None if request is None else request.model_dump(mode="json")
        with self._streamed(method, path, json=body) as answer:
            return answer.read()

    def chunks(self, path: str, request: BaseModel, warn: Callable[[str], object]) -> Generator[bytes, None, None]:
        """The body of an answer to a request, as it comes, after its warnings."""
        with self._streamed("POST", path, json=request.model_dump(mode="json")) as answer:
            for warning in self.read(answer.headers.get(WARNINGS, "[]").encode(), list[str]):
                warn(warning)
            yield from answer.iter_bytes()

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        """What is there from a byte on, as it comes."""
        with self._streamed("GET", path, headers={"Range": f"bytes={offset}-"} if offset else None) as answer:
            yield from answer.iter_bytes()

    def events(self, path: str, last: str) -> Iterator[Update]:
        """Events of a stream after `last`, until the server ends it.

        ServerError where the connection breaks, or the token does not hold any more.
        """
        with self._streamed("GET", path, headers={"Last-Event-ID": last}) as answer:
            for update in parsed(answer.iter_lines()):
                if update.kind == REFUSED:
                    raise ServerError(str(update.data))
                yield update

    @contextmanager
    def _streamed(
        self, method: str, path: str, json: JsonValue = None, headers: dict[str, str] | None = None
    ) -> Iterator[httpx.Response]:
        deadline_s = time.monotonic() + BUSY_S
        while True:
            try:
                with self._http.stream(method, path, json=json, headers=headers) as answer:
                    if answer.is_error:
                        answer.read()
                    wait_s = _busy_s(answer)
                    if wait_s is None or time.monotonic() + wait_s > deadline_s:
                        self._check(answer)
                        yield answer
                        return
            except httpx.HTTPError as error:
                raise self._unreachable(error) from None
            time.sleep(wait_s)  # a refused request has changed nothing

    def table(self, stream: bytes) -> pa.Table:
        """The table of an IPC stream that was answered."""
        try:
            return pa.ipc.open_stream(stream).read_all()
        except pa.ArrowException as error:
            raise self.nonsense(error) from None

    def nonsense(self, error: Exception) -> ServerError:
        """The error for an answer that cannot be understood."""
        line = str(error).splitlines()[0]
        return ServerError(f"server {self.url} answers what is not understood here ({line}); use the same t6gps as it")

    def _unreachable(self, error: httpx.HTTPError) -> UnreachableError:
        if isinstance(error, httpx.ReadTimeout):
            return UnreachableError(f"server {self.url} has not answered within {ANSWER_S:.0f} s; see its log")
        return UnreachableError(
            f"server {self.url} cannot be reached: {error}; correct the address, or start one with t6gps serve"
        )

    def _check(self, answer: httpx.Response) -> None:
        """The error that the server tells, if it does."""
        if answer.is_success:
            return
        try:
            refusal = Refusal.model_validate_json(answer.content)
        except ValidationError:
            raise ServerError(
                f"{self.url} answers with {answer.status_code} and no reason, so that it is no t6gps server; correct "
                "the address"
            ) from None
        raise KINDS.get(refusal.kind, ServerError)(refusal.error)

    def read(self, content: bytes, kind: type[T]) -> T:
        """What an answer says, as an object of a kind."""
        try:
            return TypeAdapter(kind).validate_json(content)
        except ValidationError as error:
            raise self.nonsense(error) from None


def _busy_s(answer: httpx.Response) -> float | None:
    """After how long a server that is busy with others wants to be asked again; None for one that has answered."""
    text = answer.headers.get("Retry-After", "")
    is_busy = answer.status_code == HTTPStatus.SERVICE_UNAVAILABLE and text.isdecimal()
    return max(float(text), SHORTEST_WAIT_S) if is_busy else None


def _checked(url: str) -> str:
    """The address without a slash at the end. ServerError where a token must not be sent."""
    try:
        whole = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ServerError(f"{url!r} is no address of a server: {error}; give http(s)://HOST:PORT") from None
    if whole.scheme not in ("http", "https") or not whole.host or whole.userinfo or whole.query:
        raise ServerError(f"{url!r} is no address of a server; give http(s)://HOST:PORT, such as http://127.0.0.1:8686")
    if whole.scheme == "http" and not _is_here(whole.host):
        raise ServerError(f"a token must not be sent to {whole.host} in the clear; give https://, which the server has")
    return str(whole).rstrip("/")


def _is_here(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def checked(kind: type[M], **values: object) -> M:
    """A request. ServerError for values that no server takes."""
    try:
        return kind(**values)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
        raise ServerError(f"this cannot be asked of a server: {faults}") from None
