"""The process that copies a run into an object store while it is trained: `python -m MODULE RUN s3://BUCKET/.../RUN`.

A line on its standard input says that something was committed, the end of the input that nothing more will be. Where
the store is away it tries again until it is back. At the end it does so for END_S, and exits with 0 when all is there.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from pathlib import Path

from t6gps.service.steering import published
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, StoreUnreachableError, T6GpsError
from t6gps.storage.objects import place, publishing
from t6gps.storage.objects.place import ObjectPath

AGAIN_S, END_S = 2.0, 60.0
PIECE_BYTES = 4096
NICENESS = 10
"""Workers and learner go first."""


def main() -> int:
    """Copy until the input ends; 0 when everything is there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal; whoever started this process ends it
    os.nice(NICENESS)
    run, target = Run(Path(sys.argv[1])), place.whole(Path(sys.argv[2]))
    probed, until_s = False, float("inf")
    while True:
        error: Exception | None = None
        try:
            if not probed:
                publishing.probe(target.parent)
                probed = True
            publishing.publish(run.path, target, publishing.AT_WORK)
        except (T6GpsError, OSError) as trouble:
            error = trouble
        tell(run, target, error)
        away = isinstance(error, StoreUnreachableError | OSError)
        if until_s < float("inf") and (not away or time.monotonic() > until_s):
            return int(error is not None)
        if until_s == float("inf") and _ended(AGAIN_S if away else None):
            until_s = time.monotonic() + END_S
        elif away:
            time.sleep(AGAIN_S)


def tell(run: Run, target: ObjectPath, error: Exception | None) -> None:
    """Say of a run how far it is copied, and what the last attempt met."""
    try:
        there_n = publishing.iterations(target)
    except (T6GpsError, OSError):
        before = _known(run)
        there_n = 0 if before is None or before["to"] != str(target) else before["iterations"]
    published.write(run, {"to": str(target), "iterations": there_n, "error": None if error is None else str(error)})


def _known(run: Run) -> published.Published | None:
    """What was said of the run, None also where a power failure has torn it."""
    try:
        return published.standing(run)
    except RunError:
        return None


def _ended(timeout_s: float | None) -> bool:
    """Wait for a line, so long at most; True at the end of the input."""
    heard, _, _ = select.select([sys.stdin], [], [], timeout_s)
    return bool(heard) and not os.read(sys.stdin.fileno(), PIECE_BYTES)


if __name__ == "__main__":
    sys.exit(main())
