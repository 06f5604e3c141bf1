"""Runs that this server lets train: each is a job of its machine, as of `t6gps submit`, and outlives the server."""

from __future__ import annotations

import threading
from collections.abc import Callable

from t6gps.service.config import Config
from t6gps.service.launch import submission
from t6gps.service.launch.target import Kind, Local
from t6gps.service.launch.targets.local import LocalLauncher
from t6gps.storage.catalog import Run

Launch = Callable[[Run, Config], str]
_one_at_a_time = threading.Lock()
"""Of two who resume a run at the same time, the second finds it at work."""


def launch(run: Run, config: Config) -> str:
    """Let a job train what is missing of a run; the job's name. RunError where somebody trains it already."""
    with _one_at_a_time:
        planned, launcher = submission.continuing(run, config), LocalLauncher()
        launcher.check([planned])
        (job,) = submission.submit(launcher, Kind.LOCAL, Local(), run.name, [planned])
    return job.name
