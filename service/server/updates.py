"""What happens to a run, as server-sent events.

event: iteration   an iteration was committed; data is its row of the table `iterations`, id its number. Each comes once
event: status      the run's condition is another than before; data is its status. A state, so that it has no id
event: fault       the run cannot be read; data is the reason, and the stream ends

Who was cut off sends the last id as Last-Event-ID, as browsers do, and goes on after it.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from anyio import to_thread

from t6gps.service.steering import status as statuses
from t6gps.service.training.summary import iterations
from t6gps.storage.catalog import Run
from t6gps.storage.errors import T6GpsError

POLL_S, ALIVE_S = 0.5, 15.0
ALIVE = ": alive\n\n"
NONE = -1
"""The id before the first iteration."""


@dataclass
class Follower:
    """Follows a run from an iteration on.

    last   number of the iteration that was told last
    """

    run: Run
    last: int = NONE
    _stamp: int = NONE
    _told: str = field(default="")

    def news(self) -> list[str]:
        """The events since it was asked last."""
        return [*self._status(), *self._iterations()]

    def _status(self) -> list[str]:
        try:
            status = statuses.status(self.run)
        except T6GpsError:  # it never had workers, or is gone; its iterations say the rest
            return []
        condition = json.dumps([status["state"], status["reason"], status["phase"], status["wanted"], status["ready"]])
        if condition == self._told:
            return []
        self._told = condition
        return [_event("status", status)]

    def _iterations(self) -> list[str]:
        try:
            log = self.run.tables / "episodes" / "_delta_log"  # of the table that is committed last
            stamp = log.stat().st_mtime_ns
        except FileNotFoundError:
            return []
        if stamp == self._stamp:
            return []
        rows = iterations(self.run, self.last + 1)
        self._stamp = stamp
        events = [_event("iteration", row, int(row["iteration"] or 0)) for row in rows]
        self.last += len(rows)
        return events


async def stream(run: Run, last: int, poll_s: float = POLL_S) -> AsyncIterator[str]:
    """Events of a run after the iteration `last`, as they come, for as long as somebody listens."""
    follower, spoken_s = Follower(run, last), time.monotonic()
    yield ALIVE
    while True:
        try:
            news = await to_thread.run_sync(follower.news)
        except T6GpsError as error:
            yield _event("fault", str(error))
            return
        for event in news:
            yield event
            spoken_s = time.monotonic()
        if time.monotonic() - spoken_s > ALIVE_S:
            yield ALIVE
            spoken_s = time.monotonic()
        await asyncio.sleep(poll_s)


def _event(kind: str, data: object, identity: int | None = None) -> str:
    head = f"event: {kind}\n" + ("" if identity is None else f"id: {identity}\n")
    return f"{head}data: {json.dumps(data)}\n\n"
