"""How a running run tells how it is: RUN/pool/status.json, written by its process.

It is written at most every PUBLISH_S, and when the run's condition changes. Reading it takes no permission to write.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Required

from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic cannot check those of `typing` before Python 3.12

from t6gps.service.pool.outside import Situation
from t6gps.service.pool.state import RunState, Worker, WorkerPhase
from t6gps.service.steering import published
from t6gps.service.steering.published import Published
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

PUBLISH_S = 0.5
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

    request           id of the last request that was taken
    phases_s          time in each phase since the process began (s)
    durable_for_s     since the newest episode became durable (s), None before the first
    backlog           episodes of the batch that are neither durable nor quarantined
    leases, arrived   of these, with a worker, and back but not durable
    episodes          counts of the whole run, by `ledger.COUNTERS`;   processes    of workers
    published         how far it is copied into an object store, where it is
    """

    time_s: Required[float]
    pid: Required[int]
    request: str | None
    most: int
    state: Required[str]
    reason: str
    phase: str
    phases_s: dict[str, float]
    durable_for_s: float | None
    wanted: int
    ready: int
    workers: Required[list[WorkerStatus]]
    backlog: int
    leases: int
    arrived: int
    bytes_in_flight: int
    waits: Required[list[Wait]]
    quarantined: list[int]
    episodes: dict[str, int]
    processes: dict[str, int]
    published: Published


_STATUS = TypeAdapter(Status)


def describe(situation: Situation, request: str | None, most: int) -> Status:
    """The status of this process's run, which a pool's situation makes; see `Status` for the others."""
    state, now, waits_since_s = situation.state, situation.now_s, situation.waits_since_s
    ledger, workers = state.ledger, list(state.workers.values())
    idle_s = [now - worker.since_s for worker in workers if worker.phase is WorkerPhase.IDLE]
    waits: list[Wait] = [{"what": what, "for_s": round(now - since_s, 3)} for what, since_s in waits_since_s.items()]
    if idle_s and not ledger.waiting:
        waits.append({"what": f"{len(idle_s)} workers wait for plans", "for_s": round(min(idle_s), 3)})
    under_way_n = len(ledger.leases) + ledger.arrived
    return {
        "time_s": time.time(),
        "pid": os.getpid(),
        "request": request,
        "most": most,
        "state": state.condition,
        "reason": state.reason,
        "phase": situation.phase,
        "phases_s": {phase: round(spent_s, 3) for phase, spent_s in situation.phases_s.items()},
        "durable_for_s": None if situation.durable_s is None else round(now - situation.durable_s, 3),
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


def publish(run: Run, status: Status) -> None:
    """Replace a run's status in one step. It need not survive a crash: then it would be wrong."""
    path = run.pool / "status.json"
    path.parent.mkdir(exist_ok=True)
    draft = durable.hidden(path)
    draft.write_text(json.dumps(status) + "\n")
    draft.replace(path)


def last_said(run: Run) -> Status | None:
    """The status as the run's process wrote it last, None when the run never had workers. RunError when damaged."""
    path = run.pool / "status.json"
    try:
        return _STATUS.validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError as error:
        fault = error.errors()[0]
        reason = f"{'.'.join(map(str, fault['loc'])) or 'the file'}: {fault['msg']}"
    except OSError as error:
        reason = str(error.strerror)
    raise RunError(f"cannot read {path}: {reason}; resume the run, which writes it anew")


def begun(root: Path, name: str) -> Status | None:
    """How a run below a root is, None where it is not there yet, or has had no workers yet."""
    if not catalog.exists(root, name):
        return None
    run = catalog.open_run(root, name)
    return None if last_said(run) is None else status(run)


def status(run: Run) -> Status:
    """The newest status of a run, with `for_s` counted up to now.

    What a process left behind that has ended without a word is said to be STOPPED. RunError when the run has none.
    """
    newest, copied = _newest(run), published.standing(run)
    return newest if copied is None else {**newest, "published": copied}


def _newest(run: Run) -> Status:
    newest = last_said(run)
    if newest is None:
        raise RunError(f"run {run.name} has no status: it was never run with workers; start it with t6gps train")
    if newest["state"] in ENDED:
        return newest
    if catalog.process_of(run) != newest["pid"]:
        reason = "its process has ended; resume with --resume"
        return {**newest, "state": RunState.STOPPED, "reason": reason, "workers": []}
    age_s = time.time() - newest["time_s"]
    for entry in (*newest["workers"], *newest["waits"]):
        entry["for_s"] += age_s
    return newest
