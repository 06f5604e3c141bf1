"""How a running run is told how many workers it shall have, and how it tells how it is: two files in its folder.

RUN/pool/scale_request.json   {"id", "workers"}: written by `scale`, durable
RUN/pool/status.json          written by the pool at most every PUBLISH_S, and when its condition changes
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Mapping

from typing_extensions import TypedDict  # pydantic cannot check those of `typing` before Python 3.12

from t6gps.service.pool.state import PoolState, RunState, Worker, WorkerPhase
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

TICK_S = 0.1
PUBLISH_S = 0.5
SCALE_DEADLINE_S = 30.0
ENDED = (RunState.DONE, RunState.FAILED)


class WorkerStatus(TypedDict):
    """A worker's line; ages in seconds."""

    slot: int
    incarnation: int
    pid: int | None
    node: str | None
    phase: str
    for_s: float
    episodes: list[int]


class Wait(TypedDict):
    """Somebody waits for somebody."""

    what: str
    for_s: float


class Status(TypedDict, total=False):
    """How a run is. `ready` of `wanted` workers take plans; `most` may be asked for.

    backlog           episodes of the batch that are neither durable nor quarantined
    leases, arrived   of these, with a worker, and back but not durable
    episodes          counts of the whole run, by `ledger.COUNTERS`;   processes    of workers
    """

    time_s: float
    pid: int
    scale_request: str | None
    most: int
    state: str
    reason: str
    phase: str
    wanted: int
    ready: int
    workers: list[WorkerStatus]
    backlog: int
    leases: int
    arrived: int
    bytes_in_flight: int
    waits: list[Wait]
    quarantined: list[int]
    episodes: dict[str, int]
    processes: dict[str, int]


def describe(state: PoolState, phase: str, waits_since_s: Mapping[str, float], now: float) -> Status:
    """The status that a pool's state makes, with the run's phase and the waits that it knows of."""
    ledger, workers = state.ledger, list(state.workers.values())
    idle_s = [now - worker.since_s for worker in workers if worker.phase is WorkerPhase.IDLE]
    waits: list[Wait] = [{"what": what, "for_s": round(now - since_s, 3)} for what, since_s in waits_since_s.items()]
    if idle_s and not ledger.waiting:
        waits.append({"what": f"{len(idle_s)} workers wait for plans", "for_s": round(min(idle_s), 3)})
    under_way_n = len(ledger.leases) + ledger.arrived
    return {
        "state": state.condition,
        "reason": state.reason,
        "phase": phase,
        "wanted": state.wanted,
        "ready": sum(worker.ready for worker in workers),
        "workers": [_describe_worker(worker, now) for worker in workers],
        "backlog": ledger.backlog,
        "leases": len(ledger.leases),
        "arrived": ledger.arrived,
        "bytes_in_flight": under_way_n * state.largest_bytes,
        "waits": waits,
        "quarantined": sorted(ledger.quarantined),
        "episodes": dict(ledger.counters),
        "processes": dict(state.counters),
    }


def _describe_worker(worker: Worker, now: float) -> WorkerStatus:
    return {
        "slot": worker.id.slot,
        "incarnation": worker.id.incarnation,
        "pid": worker.identity.pid if worker.identity else None,
        "node": worker.identity.node if worker.identity else None,
        "phase": worker.phase,
        "for_s": round(now - worker.since_s, 3),
        "episodes": [plan.episode_id for plan in worker.plans],
    }


class Control:
    """The pool's side; without a run (an evaluation, a benchmark) nobody is there to ask or to read."""

    def __init__(self, run: Run | None, workers_most: int) -> None:
        self._run, self._most = run, workers_most
        self._path = None if run is None else run.pool / "scale_request.json"
        self._published_s, self._condition = -PUBLISH_S, ""
        self._seen = self._changed()  # asked of a process that has ended since
        self._request_id: str | None = None

    def scale_request(self) -> int | None:
        """The number of workers that somebody newly asks for, None when nobody does."""
        changed = self._changed()
        if self._path is None or changed == self._seen:
            return None
        self._seen = changed
        request = json.loads(self._path.read_text())
        self._request_id, self._condition = request["id"], ""  # answered at once
        return min(max(int(request["workers"]), 0), self._most)

    def due(self, now_s: float, condition: str) -> bool:
        """True when the status is to be published."""
        if self._run is None or (condition == self._condition and now_s - self._published_s < PUBLISH_S):
            return False
        self._published_s, self._condition = now_s, condition
        return True

    def publish(self, status: Status) -> None:
        """Replace the status in one step. It need not survive a crash: then it would be wrong."""
        if self._run is None:
            return
        path = self._run.pool / "status.json"
        path.parent.mkdir(exist_ok=True)
        known = {"time_s": time.time(), "pid": os.getpid(), "scale_request": self._request_id, "most": self._most}
        draft = durable.hidden(path)
        draft.write_text(json.dumps({**known, **status}) + "\n")
        draft.replace(path)

    def _changed(self) -> int | None:
        if self._path is None:
            return None
        try:
            return self._path.stat().st_mtime_ns
        except FileNotFoundError:
            return None


def status(run: Run) -> Status:
    """The newest status of a run, with `for_s` counted up to now.

    What a process left behind that has ended without a word is said to be STOPPED. RunError when the run has none.
    """
    path = run.pool / "status.json"
    try:
        newest: Status = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(
            f"run {run.name} has no status: it was never run with workers; start it with t6gps train"
        ) from None
    except (OSError, ValueError) as error:
        raise RunError(f"cannot read {path}: {error}; resume the run, which writes it anew") from None
    if newest["state"] in ENDED:
        return newest
    if catalog.process_of(run) != newest["pid"]:
        reason = "its process has ended; resume with --resume"
        return {**newest, "state": RunState.STOPPED, "reason": reason, "workers": []}
    age_s = time.time() - newest["time_s"]
    for entry in (*newest["workers"], *newest["waits"]):
        entry["for_s"] += age_s
    return newest


def scale(run: Run, workers: int, deadline_s: float = SCALE_DEADLINE_S) -> Status:
    """Give a running run `workers` workers (0 pauses it) and wait until it has them; its status then.

    RunError, and nothing changed, when the run is not running or the number is not allowed; RunError when the request
    stands but is not fulfilled by the deadline.
    """
    before = status(run)
    if before["state"] in (RunState.STOPPED, RunState.STOPPING, *ENDED):
        reason = f": {before['reason']}" if before["reason"] else ""
        raise RunError(f"run {run.name} is not running ({before['state']}{reason}); resume with t6gps train --resume")
    if not 0 <= workers <= before["most"]:
        raise RunError(f"workers must lie in 0 .. {before['most']} for run {run.name}, found {workers}")
    request = _ask(run, workers)
    deadline = time.monotonic() + deadline_s
    newest = before
    while time.monotonic() < deadline:
        newest = status(run)
        taken = newest["scale_request"] == request
        if taken and newest["ready"] == len(newest["workers"]) == workers:
            return newest
        if not taken and newest["state"] in (RunState.STOPPED, *ENDED):
            raise RunError(f"run {run.name} ended before it could be scaled ({newest['state']}: {newest['reason']})")
        time.sleep(TICK_S)
    answer = "has taken the request" if newest["scale_request"] == request else "has not answered yet"
    raise RunError(
        f"run {run.name} {answer}; {newest['ready']} of {workers} workers are ready after {deadline_s:.0f} s "
        f"({newest['state']}: {newest['reason'] or 'busy'}); see t6gps status {run.name}"
    )


def _ask(run: Run, workers: int) -> str:
    """Write a request; its id."""
    path, request = run.pool / "scale_request.json", uuid.uuid4().hex
    durable.hidden(path).write_text(json.dumps({"id": request, "workers": workers}) + "\n")
    durable.publish(path)
    return request
