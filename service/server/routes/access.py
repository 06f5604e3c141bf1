"""What routes ask for: the place that they serve, a scope, a run by its name, and a slot for heavy work."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path as Folder
from queue import SimpleQueue
from typing import Annotated, TypeAlias, cast, final

from fastapi import Depends, HTTPException, Path, Request
from fastapi.security import HTTPBearer
from pydantic import JsonValue

from t6gps.service.driving.drives import Drives
from t6gps.service.launch import job as records
from t6gps.service.launch.job import Job
from t6gps.service.remote.messages import Refusal, RunName, Scope
from t6gps.service.server import audit
from t6gps.service.server.feed import Feeds
from t6gps.service.server.launching import Launch
from t6gps.service.server.tokens import Token
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

READING_N, COPYING_N, OPERATING_N, STREAMS_N = 2, 2, 8, 64
"""How much may be under way at once: readings of a run, lists of files with their digests, changes that wait for their
effect, streams of events."""
ASKING_N, ASKING_OF_TOKEN_N = 4, 2
"""Queries at once, and those of one token: each may take 2 GiB of memory, and nobody keeps others from asking."""
ANSWERS_N, ANSWERS_OF_TOKEN_N = 16, 4
"""Results that wait to be taken, each a file of 1 GB at most."""
BUSY = "the server is busy with other requests of this kind; ask again in a second"
Answers: TypeAlias = dict[int | str, dict[str, object]]
REFUSED = (
    HTTPStatus.BAD_REQUEST,
    HTTPStatus.UNAUTHORIZED,
    HTTPStatus.FORBIDDEN,
    HTTPStatus.NOT_FOUND,
    HTTPStatus.REQUEST_TIMEOUT,
    HTTPStatus.CONFLICT,
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    HTTPStatus.UNPROCESSABLE_ENTITY,
    HTTPStatus.TOO_MANY_REQUESTS,
    HTTPStatus.SERVICE_UNAVAILABLE,
)
REFUSALS: Answers = {int(status): {"model": Refusal, "description": status.phrase} for status in REFUSED}
"""How any route may refuse."""


class NoSuchRunError(RunError):
    """A run that is not there."""


@final
class Slots:
    """Room for so much at once. Who finds none is told to come back, and nobody queues."""

    def __init__(self, most_n: int) -> None:
        self._free = threading.Semaphore(most_n)

    def take(self) -> None:
        """Take a slot. HTTPException where there is none."""
        if not self._free.acquire(blocking=False):
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, BUSY, {"Retry-After": "1"})

    def give_back(self) -> None:
        """Give it back."""
        self._free.release()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Hold a slot meanwhile."""
        self.take()
        try:
            yield
        finally:
            self.give_back()


@final
class Shares:
    """Slots of which one token may have no more than so many."""

    def __init__(self, most_n: int, of_token_n: int) -> None:
        self._most_n, self._of_token_n = most_n, of_token_n
        self._taken: Counter[str] = Counter()
        self._returned: SimpleQueue[str] = SimpleQueue()
        self._lock = threading.Lock()

    def take(self, token: Token) -> None:
        """Take a slot for a token. HTTPException where there is none for it."""
        with self._lock:
            while not self._returned.empty():
                self._taken[self._returned.get()] -= 1
            self._taken = +self._taken
            if self._taken.total() >= self._most_n or self._taken[token.id] >= self._of_token_n:
                raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, BUSY, {"Retry-After": "1"})
            self._taken[token.id] += 1

    def give_back(self, token: Token) -> None:
        """Give it back; without a lock, since the collector of garbage may do so at any moment."""
        self._returned.put(token.id)

    @contextmanager
    def taken(self, token: Token) -> Iterator[None]:
        """Hold a slot meanwhile."""
        self.take(token)
        try:
            yield
        finally:
            self.give_back(token)


@dataclass(frozen=True)
class Served:
    """What a server serves: a root, what lets a job train a run, what is listened to, and room for heavy work.

    query_s   that a query may take
    drives    policies that somebody drives
    holds     whether a token that was good still is
    """

    root: Folder
    launch: Launch
    query_s: float
    drives: Drives
    holds: Callable[[Token], bool]
    reading: Slots = field(default_factory=lambda: Slots(READING_N))
    copying: Slots = field(default_factory=lambda: Slots(COPYING_N))
    operating: Slots = field(default_factory=lambda: Slots(OPERATING_N))
    streams: Slots = field(default_factory=lambda: Slots(STREAMS_N))
    asking: Shares = field(default_factory=lambda: Shares(ASKING_N, ASKING_OF_TOKEN_N))
    answers: Shares = field(default_factory=lambda: Shares(ANSWERS_N, ANSWERS_OF_TOKEN_N))
    feeds: Feeds = field(default_factory=Feeds)


async def _served(request: Request) -> Served:  # async: what reads no file needs no thread
    return cast(Served, request.app.state.served)


async def _token(request: Request) -> Token:
    return cast(Token, request.state.token)


Place = Annotated[Served, Depends(_served)]
Asker = Annotated[Token, Depends(_token)]
_bearer = HTTPBearer(auto_error=False, description="A token of `t6gps token create`, with scope and expiry.")


def _check(request: Request, scope: Scope) -> None:
    token = request.state.token
    if not token.scope.includes(scope):
        sentence = f"token {token.name!r} has scope {token.scope}, this needs {scope}; ask for another token"
        raise HTTPException(HTTPStatus.FORBIDDEN, sentence)


def _asking(scope: Scope) -> Callable[..., Awaitable[None]]:
    async def check(request: Request, _: Annotated[object, Depends(_bearer)]) -> None:
        _check(request, scope)

    return check


def _changing(scope: Scope) -> Callable[..., dict[str, JsonValue]]:
    def note(request: Request, place: Place, _: Annotated[object, Depends(_bearer)]) -> dict[str, JsonValue]:
        audit.prepare(place.root)
        request.state.change = {}
        _check(request, scope)
        return cast("dict[str, JsonValue]", request.state.change)

    return note


Reading, Operating, Administering = (Depends(_asking(scope)) for scope in Scope)
"""Of routes that change nothing that is kept."""
Operation = Annotated[dict[str, JsonValue], Depends(_changing(Scope.OPERATE))]
Administration = Annotated[dict[str, JsonValue], Depends(_changing(Scope.ADMIN))]
"""Of a route that changes something: what the audit shall say of it, beside who and when."""


def contents(kinds: Iterable[str], what: str) -> Answers:
    """What a route answers with that is no JSON, for the document."""
    return {200: {"content": {kind: {} for kind in kinds}, "description": what}}


Name = Annotated[RunName, Path(description="Name of a run.")]


def training(place: Served, name: str) -> Job | None:
    """The job that trains a run of the root."""
    return records.training(place.root, name)


def named(place: Place, name: Name) -> Run:
    """The run of that name. NoSuchRunError where there is none."""
    try:
        return catalog.open_run(place.root, name)
    except RunError as error:
        raise NoSuchRunError(*error.args) from None


NamedRun = Annotated[Run, Depends(named)]
