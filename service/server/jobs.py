"""Runs at work in the background, in sessions of their own: they outlive the server that started them.

Run as a program, `jobs ROOT NAME` trains what is missing of a run, as `t6gps train --resume` does. What it says is kept
in ROOT/.server/logs/NAME.log.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.server.tokens import folder
from t6gps.service.steering import requests
from t6gps.service.training import origin, session
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, T6GpsError

Launch = Callable[[Run], int]
EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
_log = logging.getLogger(__name__)
_children: list[subprocess.Popen[bytes]] = []
"""Those that were started here, to be asked for how they ended: nobody else can."""


def launch(run: Run) -> int:
    """Let a process of its own work on a run; its number. RunError where one does already."""
    if catalog.process_of(run) is not None:
        raise RunError(f"run {run.name} is running already; see t6gps status {run.name}")
    _children[:] = [child for child in _children if child.poll() is None]
    logs = folder(run.path.parent) / "logs"
    logs.mkdir(mode=0o700, exist_ok=True)
    command = [sys.executable, "-P", "-m", __name__, str(run.path.parent), run.name]
    with (logs / f"{run.name}.log").open("ab") as log:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, cwd=run.path.parent
        )
    _children.append(child)
    return child.pid


def resume(run: Run, start: Launch) -> int:
    """Let a paused run have its workers again, or a stopped one a process; its process. RunError where it runs."""
    pid = catalog.process_of(run)
    if pid is None:
        return start(run)
    requests.unpause(run)
    return pid


class _Diary:
    """Says in the log how far a run is."""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        """Nothing: the status says so."""

    def finished(self, row: Mapping[str, int | float | None]) -> None:
        """An iteration is committed."""
        _log.info("iteration %s is committed, cost %s", row["iteration"], row["cost"])


def work(root: Path, name: str) -> None:
    """Train what is missing of a run, evaluate its policy, and draw its figures."""
    run = catalog.open_run(root, name)
    session.tell_changes(run, _log.warning)
    _log.info("run %s is at work in process %d", name, os.getpid())
    session.complete(configuration.kept(run), run, False, _Diary())
    from t6gps.service.views import run_figures

    run_figures.draw(run, origin.configured(run))
    _log.info("run %s is complete", name)


def main() -> int:
    """The process of a run. SIGTERM stops it, and everything sampled is kept."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    root, name = sys.argv[1:]
    try:
        work(Path(root), name)
    except T6GpsError as error:
        _log.error("%s", error)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        _log.info("run %s is stopped; everything sampled so far is kept", name)
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
