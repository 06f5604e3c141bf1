"""What happened to a run, for people: RUN/pool/events.jsonl, one line an event, each with its reason.

Events follow from what the supervisor observed and decided (`of`). They are numbered from 0, and the file goes on when
the run is resumed. One of LARGEST_BYTES is renamed to `events.1.jsonl`, and a new one begins.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from typing_extensions import TypedDict  # pydantic cannot check those of `typing` before Python 3.12

from t6gps.service.pool import messages, scaling
from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.state import Ending, PoolState, RunState
from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

LARGEST_BYTES, LOOK_S = 2**20, 0.2
FILE, OLDER = "events.jsonl", "events.1.jsonl"


class EventKind(StrEnum):
    """What happens."""

    START = "start"
    """Workers start in slots that were empty."""
    SCALE = "scale"
    """Another number of workers is wanted."""
    CRASH = "crash"
    """A worker's process ended by itself, or could not start."""
    HANG = "hang"
    """A worker missed a deadline."""
    REPLACEMENT = "replacement"
    """A worker starts in the place of one that failed."""
    QUARANTINE = "quarantine"
    """An episode is not tried any more."""
    WAITING = "waiting"
    """Workers wait for a CPU."""
    RUNNING = "running"
    """As many workers as asked for are ready."""
    DEGRADED = "degraded"
    """Fewer are."""
    PAUSED = "paused"
    """The run was scaled to none."""
    STOPPING = "stopping"
    """The run is being stopped."""
    DONE = "done"
    """All iterations and the evaluation are kept."""
    FAILED = "failed"
    """The run cannot continue."""


NO_TROUBLE = {
    RunState.RUNNING: "as many workers as asked for are ready",
    RunState.DONE: "all iterations and the evaluation are kept",
}
"""Reasons of conditions that have none in the state."""


@dataclass(frozen=True)
class Happened:
    """An event without its time: what, and why, in words; of which slot and episode, None where it has none."""

    event: EventKind
    reason: str
    slot: int | None = None
    episode: int | None = None


class Event(TypedDict):
    """A line of the file: the time is UTC in ISO 8601, `phase` what the run did."""

    number: int
    time: str
    event: str
    phase: str
    reason: str


@dataclass(frozen=True)
class Standing:
    """What events are told from: how a pool is between two rounds; it begins with no worker."""

    wanted: int
    condition: RunState = RunState.DEGRADED
    waiting_n: int = 0


def standing(state: PoolState) -> Standing:
    """Of a pool as it is."""
    waiting_n = sum(scaling.pending(state, worker) for worker in state.workers.values())
    return Standing(state.wanted, state.condition, waiting_n)


def of(
    before: Standing,
    after: Standing,
    state: PoolState,
    observed: Sequence[Observation],
    decided: Sequence[Instruction],
) -> list[Happened]:
    """What happened in a round that observed and decided this, and brought a pool from `before` to `after`.

    `state` is that after the round.
    """
    return [
        *_scaled(before, state, observed),
        *(happened for instruction in decided for happened in _done(state, instruction)),
        *_started(state, decided),
        *_turned(before, after, state),
    ]


def _scaled(before: Standing, state: PoolState, observed: Sequence[Observation]) -> Iterator[Happened]:
    if before.wanted == state.wanted:
        return
    by = "autoscaling, by backlog and room"
    for observation in observed:
        if isinstance(observation, messages.ScaleRequested):
            by = "asked for" if observation.workers else "a pause was asked for"
        elif isinstance(observation, messages.UnpauseRequested):
            by = "the end of the pause was asked for"
    yield Happened(EventKind.SCALE, f"workers, from {before.wanted} to {state.wanted}: {by}")


def _done(state: PoolState, instruction: Instruction) -> Iterator[Happened]:
    """What a single instruction tells."""
    match instruction:
        case messages.End() if instruction.why is not Ending.DRAINED:
            kind = EventKind.HANG if instruction.why is Ending.HANG else EventKind.CRASH
            slot = instruction.worker.slot
            plans = state.workers[slot].plans
            in_hand = plans[0].episode_id if plans else None
            yield Happened(kind, f"worker {instruction.worker}: {state.slots[slot].trouble}", slot, in_hand)
        case messages.Start() if trouble := state.slots[instruction.worker.slot].trouble:
            reason = f"worker {instruction.worker}; the last one there: {trouble}"
            yield Happened(EventKind.REPLACEMENT, reason, instruction.worker.slot)
        case messages.Quarantine():
            number = instruction.plan.episode_id
            history = state.ledger.failures[number]
            reason = f"episode {number} after {len(history)} attempts; the last: {history[-1]}"
            yield Happened(EventKind.QUARANTINE, reason, episode=number)


def _started(state: PoolState, decided: Sequence[Instruction]) -> Iterator[Happened]:
    """Workers that start where none has failed, together: there may be hundreds."""
    slots = [
        each.worker.slot
        for each in decided
        if isinstance(each, messages.Start) and not state.slots[each.worker.slot].trouble
    ]
    if slots:
        where = f"slot {slots[0]}" if len(slots) == 1 else f"{len(slots)} slots from {min(slots)} to {max(slots)}"
        yield Happened(EventKind.START, f"{where}: {state.wanted} wanted")


def _turned(before: Standing, after: Standing, state: PoolState) -> Iterator[Happened]:
    """Another condition, or a wait for CPUs that begins."""
    if after.condition is not before.condition:
        yield Happened(EventKind(after.condition.lower()), state.reason or NO_TROUBLE[after.condition])
    if after.waiting_n and not before.waiting_n:
        yield Happened(EventKind.WAITING, state.reason)


class EventLog:
    """Writes the events of a run in a folder."""

    def __init__(self, folder: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        folder.mkdir(exist_ok=True)
        self._path, self._largest_bytes = folder / FILE, largest_bytes
        if self._path.exists():  # perhaps the machine went down in the middle of a line
            os.truncate(self._path, self._path.read_bytes().rfind(b"\n") + 1)
        self._next = _last_number(folder) + 1

    def write(self, happened: Sequence[Happened], phase: str) -> None:
        """Add events that happened now. They need not survive a crash of the machine."""
        if not happened:
            return
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        events: list[Event] = [
            {"number": number, "time": now, "event": each.event, "phase": phase, "reason": each.reason}
            for number, each in enumerate(happened, self._next)
        ]
        self._next += len(events)
        lines = "".join(json.dumps(event) + "\n" for event in events)
        if self._path.exists() and self._path.stat().st_size + len(lines) > self._largest_bytes:
            self._path.replace(self._path.with_name(OLDER))
        with self._path.open("a", encoding="ascii") as file:
            file.write(lines)


def read(run: Run) -> list[Event]:
    """The events of a run that are kept, the first first; none when it never had workers. RunError when damaged."""
    return _kept(run.pool)


def stamp(run: Run) -> tuple[int, ...]:
    """What changes whenever `read` gives something new."""
    try:
        found = (run.pool / FILE).stat()
    except OSError:  # `read` says which
        return ()
    return found.st_ino, found.st_size


def follow(run: Run, look_s: float = LOOK_S) -> Iterator[Event]:
    """The events of a run that are kept, and those to come, for as long as somebody listens. RunError as `read`."""
    told, seen = -1, tuple[int, ...]()
    while True:
        now = stamp(run)
        if now != seen:
            seen = now
            for event in read(run):
                if event["number"] > told:
                    told = event["number"]
                    yield event
        time.sleep(look_s)


def _kept(folder: Path) -> list[Event]:
    events: list[Event] = []
    newest_first = [(path, _content(path)) for path in (folder / FILE, folder / OLDER)]  # one may become the other
    for path, content in reversed(newest_first):
        for number, line in enumerate(content.splitlines(keepends=True), 1):
            try:
                event: Event = durable.parsed(line)
                if not events or event["number"] > events[-1]["number"]:
                    events.append(event)
            except (ValueError, TypeError, KeyError) as error:
                if line.endswith(b"\n"):
                    raise RunError(f"{path}: line {number} is no event: {error}; remove the line") from None
                # else it was being written when the machine went down, or is at this moment
    return events


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}; get permission to read it") from error


def _last_number(folder: Path) -> int:
    """The number of the last event that is whole, -1 where there is none; a damaged line stops no run."""
    for path in (folder / FILE, folder / OLDER):
        for line in reversed(path.read_bytes().splitlines() if path.exists() else []):
            with suppress(ValueError, TypeError, KeyError):
                return int(durable.parsed(line)["number"])
    return -1
