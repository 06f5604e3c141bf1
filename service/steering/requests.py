"""What somebody asks of a running run: RUN/request.json, `{"id", "what", "workers"}`.

There is one file. A request replaces the one before it, and whoever waits for that one is told so at once. The run's
process reads it; the id of the last request about workers that it took stands in the status.
"""

from __future__ import annotations

import json
import logging
import time
import uuid
from dataclasses import asdict, dataclass
from enum import StrEnum

from t6gps.service.pool.state import RunState
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import ENDED, Status
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

LOOK_S = 0.1
SCALE_DEADLINE_S, STOP_DEADLINE_S = 30.0, 60.0

_log = logging.getLogger(__name__)


class What(StrEnum):
    """What can be asked."""

    WORKERS = "workers"
    UNPAUSE = "unpause"
    STOP = "stop"


@dataclass(frozen=True)
class Request:
    """What somebody asks; `workers` where it is a number of them."""

    id: str
    what: What
    workers: int | None = None

    def __str__(self) -> str:
        return f"for {self.workers} workers" if self.what is What.WORKERS else f"to {self.what}"


def read(run: Run) -> Request | None:
    """The last request since the run's process began, None when there is none. RunError when it cannot be read."""
    try:
        fields = durable.parsed(run.request.read_text(encoding="utf-8"))
        return Request(fields["id"], What(fields["what"]), fields["workers"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise RunError(f"cannot read {run.request}: {error}; remove it, and ask again") from None


class Inbox:
    """The side of the run's process: each request comes once, the last one of those that came at once."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._seen: tuple[int, ...] = ()

    def new(self) -> Request | None:
        """What somebody newly asks for; one that cannot be read is told in the log."""
        changed = self._changed()
        if changed == self._seen:
            return None
        self._seen = changed
        try:
            return read(self._run)
        except RunError as error:
            _log.warning("%s", error)
            return None

    def _changed(self) -> tuple[int, ...]:
        try:
            found = self._run.request.stat()
        except FileNotFoundError:
            return ()
        return found.st_ino, found.st_mtime_ns


def scale(run: Run, workers: int, deadline_s: float = SCALE_DEADLINE_S) -> Status:
    """Give a running run `workers` workers, none to pause it, and wait until it has them; its status then.

    RunError, and nothing changed, when the run is not running or the number is not allowed; RunError when another
    request overtakes this one, or when it stands but is not fulfilled by the deadline.
    """
    before = _running(run)
    if not 0 <= workers <= before["most"]:
        raise RunError(f"workers must lie in 0 .. {before['most']} for run {run.name}, found {workers}")
    return _reached(run, _ask(run, What.WORKERS, workers), deadline_s)


def pause(run: Run, deadline_s: float = SCALE_DEADLINE_S) -> Status:
    """Scale a running run to no workers, and let it remember how many it had. Status and errors as `scale`."""
    return scale(run, 0, deadline_s)


def unpause(run: Run, deadline_s: float = SCALE_DEADLINE_S) -> Status:
    """Give a paused run what it had before: its workers, or its autoscaling. Status and errors as `scale`."""
    before = _running(run)
    if before["state"] != RunState.PAUSED:
        raise RunError(f"run {run.name} is not paused ({before['state']}); see t6gps status {run.name}")
    return _reached(run, _ask(run, What.UNPAUSE), deadline_s)


def stop(run: Run, deadline_s: float = STOP_DEADLINE_S) -> str:
    """Stop a running run as SIGTERM does, and wait until what it started has ended; how it is then, in words.

    RunError when no process runs it, when another request overtakes this one, or at the deadline; the request stands.
    """
    process = catalog.process_of(run)
    if process is None:
        raise RunError(f"run {run.name} is not running; there is nothing to stop")
    request = _ask(run, What.STOP)
    deadline = time.monotonic() + deadline_s
    while catalog.process_of(run) is not None:
        if run.path.exists():
            _check_not_overtaken(run, request)
        if time.monotonic() > deadline:
            raise RunError(
                f"run {run.name} was asked to stop, and its process {process} has not done so within {deadline_s:.0f} "
                "s; the request stands. Wait, or end that process"
            )
        time.sleep(LOOK_S)
    if not run.path.exists():
        return "stopped before anything was sampled; nothing is left of it"
    try:
        state = statuses.status(run)["state"]
    except RunError:  # it ran without workers of its own, or had none yet
        state = RunState.STOPPED
    return f"{state}; --resume continues it" if state == RunState.STOPPED else state


def _running(run: Run) -> Status:
    """The status of a run that can be asked for something. RunError when it is not running, or being stopped."""
    newest = statuses.status(run)
    if newest["state"] in (RunState.STOPPED, RunState.STOPPING, *ENDED):
        reason = f": {newest['reason']}" if newest["reason"] else ""
        raise RunError(f"run {run.name} is not running ({newest['state']}{reason}); resume with t6gps train --resume")
    last = read(run)
    if last is not None and last.what is What.STOP:
        raise RunError(f"run {run.name} is being stopped; resume with t6gps train --resume")
    return newest


def _ask(run: Run, what: What, workers: int | None = None) -> Request:
    request = Request(uuid.uuid4().hex, what, workers)
    durable.replace(run.request, json.dumps(asdict(request)).encode() + b"\n")
    return request


def _reached(run: Run, request: Request, deadline_s: float) -> Status:
    """The status in which a request for workers is fulfilled. RunError when it is not to be."""
    deadline = time.monotonic() + deadline_s
    while True:
        newest = statuses.status(run)
        taken = newest["request"] == request.id
        if taken and newest["ready"] == len(newest["workers"]) == newest["wanted"]:
            return newest
        if newest["state"] in (RunState.STOPPED, *ENDED):
            raise RunError(f"run {run.name} ended before it could be scaled ({newest['state']}: {newest['reason']})")
        _check_not_overtaken(run, request)
        if time.monotonic() > deadline:
            break
        time.sleep(LOOK_S)
    answer = "has taken the request" if taken else "has not answered yet"
    wanted = newest["wanted"] if request.workers is None else request.workers
    raise RunError(
        f"run {run.name} {answer}; {newest['ready']} of {wanted} workers are ready after {deadline_s:.0f} s "
        f"({newest['state']}: {newest['reason'] or 'busy'}); see t6gps status {run.name}"
    )


def _check_not_overtaken(run: Run, request: Request) -> None:
    last = read(run)
    if last is not None and last.id != request.id:
        raise RunError(
            f"the request {request} was overtaken: somebody has asked run {run.name} {last} meanwhile; see t6gps "
            f"status {run.name}, and ask again where that is not what you want"
        )
