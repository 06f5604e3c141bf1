"""A drive as its owner has it: the process that simulates, who looks, and why it ends.

Whoever looks is told, as KIND and JSON: the scene, frames, `steered` with a command of somebody, and `end` with a
sentence. Who is slow misses frames, and nothing else.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import NamedTuple, final

from t6gps.service.driving import process
from t6gps.service.driving.commands import Command
from t6gps.service.driving.order import Order
from t6gps.storage.errors import ConfigError

WAITING_N = 20
"""Frames that wait for somebody slow: two seconds."""
LONGEST_LINE_N = 2**25
"""The finest ground of a file has 8 MB."""
_log = logging.getLogger(__name__)
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}


@dataclass(frozen=True)
class Patience:
    """How long a drive goes on (s): with nobody who looks, and at most. `look_s` is how often that is seen to."""

    alone_s: float = 10.0
    longest_s: float = 1800.0
    look_s: float = 0.5


class News(NamedTuple):
    """What somebody is told: a kind, and JSON."""

    kind: str
    text: str


@final
class Watch:
    """What somebody who looks has not been told yet."""

    def __init__(self) -> None:
        self._waiting, self._some = deque[News](), asyncio.Event()

    def put(self, news: News) -> None:
        """Tell something; where too much waits, the oldest frame is forgotten."""
        if len(self._waiting) >= WAITING_N:
            oldest = next((k for k, one in enumerate(self._waiting) if one.kind == "frame"), 0)
            del self._waiting[oldest]
        self._waiting.append(news)
        self._some.set()

    async def news(self, quiet_s: float) -> AsyncIterator[News | None]:
        """What is told, up to `end`; None where nothing was for so long."""
        while True:
            while self._waiting:
                news = self._waiting.popleft()
                yield news
                if news.kind == "end":
                    return
            self._some.clear()
            try:
                await asyncio.wait_for(self._some.wait(), quiet_s)
            except TimeoutError:
                yield None


@final
class Drive:
    """One drive. `holds` is false once whoever began it may do so no more; `ended` is called at its end."""

    def __init__(self, order: Order, patience: Patience, holds: Callable[[], bool], ended: Callable[[], None]) -> None:
        self._order, self._patience, self._holds, self._ended = order, patience, holds, ended
        self._waypoint_m: list[float] | None = None
        self._watches: set[Watch] = set()
        self._scene: News | None = None
        self._last: News | None = None
        self._over: News | None = None
        self._end: str | None = None
        self._asked = asyncio.Queue[Command]()
        self._task = asyncio.create_task(self._live())

    @property
    def robots_n(self) -> int:
        """How many robots there are."""
        return len(self._order.entrants)

    def obey(self, command: Command) -> None:
        """Let the simulation do what a command says, and tell everybody. ConfigError for what it cannot."""
        order = self._order
        if command.push is not None and command.push.robot >= self.robots_n:
            raise ConfigError(f"there are {self.robots_n} robots, counted from 0; robot {command.push.robot} is none")
        if command.terrain_difficulty is not None:
            order = order.at(command.terrain_difficulty)
        waypoint_m, half_m = command.waypoint_m or self._waypoint_m, order.half_size_m
        if waypoint_m is not None and half_m is not None and max(map(abs, waypoint_m)) >= half_m:
            place = ", ".join(f"{value:.1f}" for value in waypoint_m)
            ground, remedy = ("the", "choose") if command.waypoint_m else ("that", "before it changes, head for")
            raise ConfigError(
                f"the waypoint ({place}) lies beyond {ground} ground, which reaches {half_m:.0f} m from its middle; "
                f"{remedy} a nearer one"
            )
        self._order, self._waypoint_m = order, waypoint_m
        self._asked.put_nowait(command)
        self._tell(News("steered", command.model_dump_json(exclude_none=True)))

    @contextmanager
    def watched(self) -> Iterator[Watch]:
        """Look; the scene, the newest frame and the end are told at once, if there are any yet."""
        watch = Watch()
        for news in (self._scene, self._last, self._over):
            if news is not None:
                watch.put(news)
        self._watches.add(watch)
        try:
            yield watch
        finally:
            self._watches.discard(watch)

    async def end(self, reason: str) -> None:
        """End it, for a reason that those who look are told; return when its process is gone."""
        self._end = self._end or reason
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task

    async def _live(self) -> None:
        try:
            await self._simulate()
        except* _Over as over:
            self._end = self._end or str(over.exceptions[0])
        except* Exception:
            _log.exception("a drive has failed")
            self._end = self._end or "the drive has failed, and the server's log says why; begin another one"
        finally:
            self._ended()
            reason = self._end or "the server stops; begin another drive when it is back"
            self._over = News("end", json.dumps(reason))
            self._tell(self._over)

    async def _simulate(self) -> None:
        try:
            simulation = await asyncio.create_subprocess_exec(
                *(sys.executable, "-P", "-m", process.__name__),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=LONGEST_LINE_N,
                cwd="/",
                env={**os.environ, **_ENVIRONMENT},
            )
        except OSError as failed:
            raise _Over(f"no process can be started for the drive: {failed}; try again later") from None
        try:
            orders, told = simulation.stdin, simulation.stdout
            assert orders is not None
            assert told is not None
            orders.write(process.written(self._patience.longest_s, self._order))
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._relay(told))
                tasks.create_task(self._pass_on(orders))
                tasks.create_task(self._see_to_it())
        finally:
            with suppress(ProcessLookupError):  # it has ended by itself
                simulation.kill()
            await simulation.wait()

    async def _relay(self, source: asyncio.StreamReader) -> None:
        while line := await source.readline():
            kind, _, text = line.decode().rstrip().partition(" ")
            news = News(kind, text)
            if kind == "end":
                raise _Over(json.loads(text))
            if kind == "scene":
                self._scene = news
            else:
                self._last = news
            self._tell(news)
        raise _Over("the simulation has ended, and the server's log says why; begin another drive")

    async def _pass_on(self, sink: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):  # it has ended, which the other pipe says, too
            while True:
                sink.write((await self._asked.get()).model_dump_json().encode() + b"\n")
                await sink.drain()

    async def _see_to_it(self) -> None:
        clock, patience = asyncio.get_running_loop().time, self._patience
        began_s = seen_s = clock()
        while True:
            await asyncio.sleep(patience.look_s)
            if self._watches:
                seen_s = clock()
            if not self._holds():
                raise _Over("the token that began this drive is revoked or has expired; begin another drive")
            if clock() - seen_s > patience.alone_s:
                raise _Over("nobody looked any more; begin another drive")
            if clock() - began_s > patience.longest_s:
                raise _Over(f"a drive lasts {patience.longest_s / 60:.0f} minutes at most; begin another one")

    def _tell(self, news: News) -> None:
        for watch in self._watches:
            watch.put(news)


class _Over(Exception):
    """Why a drive ends."""
