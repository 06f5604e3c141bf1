"""What happens to a run, looked at once for all who listen to it.

A cursor `I-E` says what somebody has been told: iterations up to number I - 1, and events of the pool up to E - 1.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, final

from anyio import to_thread

from t6gps.service.steering import events
from t6gps.service.steering import status as statuses
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training.summary import Row, iterations
from t6gps.storage.catalog import Run
from t6gps.storage.errors import T6GpsError

LOOK_S = 0.5


class Cursor(NamedTuple):
    """How many iterations and events somebody has been told of."""

    iterations: int
    events: int

    @classmethod
    def of(cls, text: str) -> Cursor:
        """The cursor that a text says."""
        told = text.split("-")
        return cls(int(told[0]), int(told[1]))

    def __str__(self) -> str:
        return f"{self.iterations}-{self.events}"


class News(NamedTuple):
    """Something that happened; `cursor` is that of who has been told of it, None for what is no step on the way."""

    kind: str
    data: object
    cursor: Cursor | None = None


@final
@dataclass
class Feed:
    """What was last seen of a run.

    condition   what changes when a status is worth telling
    """

    run: Run
    rows: list[Row] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    status: Status | None = None
    condition: str = ""
    _stamps: tuple[object, object] = (None, None)
    _looked_s: float = float("-inf")
    _looking: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def look(self, every_s: float) -> None:
        """See what is new, unless somebody has looked just now. An error for a run that cannot be read."""
        async with self._looking:
            if time.monotonic() - self._looked_s >= every_s:
                await to_thread.run_sync(self._look)
                self._looked_s = time.monotonic()

    def after(self, cursor: Cursor, condition: str) -> Iterator[News]:
        """What somebody has not been told who was told up to `cursor`, and of a condition."""
        for event in self.events:
            if event["number"] >= cursor.events:
                cursor = cursor._replace(events=event["number"] + 1)
                yield News("pool", event, cursor)
        for row in self.rows[cursor.iterations :]:
            cursor = cursor._replace(iterations=cursor.iterations + 1)
            yield News("iteration", row, cursor)
        if self.status is not None and self.condition != condition:
            yield News("status", self.status)

    def _look(self) -> None:
        self._look_at_status()  # first: what led to it is told before it
        committed, happened = _stamp(self.run.tables / "episodes" / "_delta_log"), events.stamp(self.run)
        if happened != self._stamps[1]:
            self.events = events.read(self.run)
        if committed != self._stamps[0]:  # of the table that is committed last
            self.rows += iterations(self.run, len(self.rows))
        self._stamps = committed, happened

    def _look_at_status(self) -> None:
        try:
            status = statuses.status(self.run)
        except T6GpsError:  # it never had workers, or is gone; its iterations say the rest
            return
        self.status = status
        self.condition = json.dumps([status[key] for key in ("state", "reason", "phase", "wanted", "ready")])


@final
class Feeds:
    """The feeds of the runs that somebody listens to."""

    def __init__(self) -> None:
        self._feeds: dict[Path, tuple[Feed, int]] = {}

    @contextmanager
    def of(self, run: Run) -> Iterator[Feed]:
        """The feed of a run, kept for as long as somebody listens."""
        feed, listeners_n = self._feeds.get(run.path, (Feed(run), 0))
        self._feeds[run.path] = feed, listeners_n + 1
        try:
            yield feed
        finally:
            _, listeners_n = self._feeds.pop(run.path)
            if listeners_n > 1:
                self._feeds[run.path] = feed, listeners_n - 1


def _stamp(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return None
