"""How a run that goes on is told how many workers it shall have, and how it tells how it is: two files in its folder.

RUN/pool/wish.json      {"id", "workers"}: written by `scale`, durable
RUN/pool/status.json    written by the supervisor at most every PUBLISH_S, and when its state changes
"""

from __future__ import annotations

import json
import os
import time
import uuid
from typing import Any

from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

TICK_S = 0.1
PUBLISH_S = 0.5
SCALE_DEADLINE_S = 30.0
ENDED = ("DONE", "FAILED")


class Control:
    """The supervisor's side; without a run (an evaluation, a benchmark) nobody is there to wish or to read."""

    def __init__(self, run: Run | None, workers_most: int) -> None:
        self._run, self._most = run, workers_most
        self._wish_path = None if run is None else run.pool / "wish.json"
        self._published_s, self._state = -PUBLISH_S, ""
        self._seen = self._changed()  # a wish for a process that has ended since
        self._wish_id: str | None = None

    def wish(self) -> int | None:
        """The number of workers that is newly wished for, None when nothing new is."""
        changed = self._changed()
        if self._wish_path is None or changed == self._seen:
            return None
        self._seen = changed
        wish = json.loads(self._wish_path.read_text())
        self._wish_id, self._state = wish["id"], ""  # answered at once
        return min(max(int(wish["workers"]), 0), self._most)

    def due(self, now_s: float, state: str) -> bool:
        """True when the status is to be published."""
        if self._run is None or (state == self._state and now_s - self._published_s < PUBLISH_S):
            return False
        self._published_s, self._state = now_s, state
        return True

    def publish(self, status: dict[str, Any]) -> None:
        """Replace the status in one step. It need not survive a crash: then it would be wrong."""
        if self._run is None:
            return
        path = self._run.pool / "status.json"
        path.parent.mkdir(exist_ok=True)
        known = {"time_s": time.time(), "pid": os.getpid(), "wish": self._wish_id, "most": self._most}
        draft = durable.hidden(path)
        draft.write_text(json.dumps(known | status) + "\n")
        draft.replace(path)

    def _changed(self) -> int | None:
        if self._wish_path is None:
            return None
        try:
            return self._wish_path.stat().st_mtime_ns
        except FileNotFoundError:
            return None


def status(run: Run) -> dict[str, Any]:
    """The newest status of a run, with `for_s` counted up to now.

    What a process left behind that has ended without a word is said to be STOPPED. RunError when the run has none.
    """
    path = run.pool / "status.json"
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError:
        raise RunError(
            f"run {run.name} has no status: it was never run with workers; start it with t6gps train"
        ) from None
    if found["state"] in ENDED:
        return found
    if catalog.holder(run) != found["pid"]:
        return found | {"state": "STOPPED", "reason": "its process has ended; go on with --resume", "workers": []}
    age_s = time.time() - found["time_s"]
    for entry in (*found["workers"], *found["waits"]):
        entry["for_s"] += age_s
    return found


def scale(run: Run, workers: int, deadline_s: float = SCALE_DEADLINE_S) -> dict[str, Any]:
    """Give a running run `workers` workers (0 pauses it) and wait until it has them; its status then.

    RunError, and nothing changed, when the run is not running or the number is not allowed; RunError when the wish
    stands but is not fulfilled by the deadline.
    """
    before = status(run)
    if before["state"] in ("STOPPED", "STOPPING", *ENDED):
        reason = f": {before['reason']}" if before["reason"] else ""
        raise RunError(f"run {run.name} is not running ({before['state']}{reason}); go on with t6gps train --resume")
    if not 0 <= workers <= before["most"]:
        raise RunError(f"workers must lie in 0 .. {before['most']} for run {run.name}, found {workers}")
    path, wish = run.pool / "wish.json", uuid.uuid4().hex
    durable.hidden(path).write_text(json.dumps({"id": wish, "workers": workers}) + "\n")
    durable.publish(path)
    deadline = time.monotonic() + deadline_s
    found = before
    while time.monotonic() < deadline:
        found = status(run)
        if found["wish"] == wish and found["ready"] == len(found["workers"]) == workers:
            return found
        if found["wish"] != wish and found["state"] in ("STOPPED", *ENDED):
            raise RunError(f"run {run.name} ended before it could be scaled ({found['state']}: {found['reason']})")
        time.sleep(TICK_S)
    taken = "has taken the wish" if found["wish"] == wish else "has not answered yet"
    raise RunError(
        f"run {run.name} {taken}; {found['ready']} of {workers} workers are ready after {deadline_s:.0f} s "
        f"({found['state']}: {found['reason'] or 'busy'}); see t6gps status {run.name}"
    )
