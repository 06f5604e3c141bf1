"""Jobs and their runs from outside, the same for who asks here and who asks a server: how they are, and their end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from t6gps.service.launch import launchers
from t6gps.service.launch.job import ENDED, Job, JobState
from t6gps.service.launch.launcher import Launcher
from t6gps.service.launch.target import Kind
from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError, T6GpsError

CANCEL_S, TICK_S = 60.0, 0.2
"""How long a job has that is ended, and how often it is looked at."""


class JobLine(BaseModel):
    """A job in a line: its record, and how it is; `state` is None where its target cannot be asked."""

    model_config = ConfigDict(frozen=True)

    name: str
    kind: Kind
    native_id: str
    run: str
    root: str
    source: str
    submitted: str
    state: JobState | None
    detail: str


class Standing(BaseModel):
    """How a run is: its job, where one trains it, and its status, where it has workers."""

    model_config = ConfigDict(frozen=True)

    job: JobLine | None
    status: Status | None


def line(job: Job) -> JobLine:
    """A job in a line, also where its target cannot be asked."""
    state: JobState | None
    try:
        state, detail = launchers.serving(job).state(job)
    except T6GpsError as error:  # one target that does not answer hides none of the others
        state, detail = None, str(error)
    return JobLine(**job.model_dump(exclude={"target"}), state=state, detail=detail)


def standing(root: Path, name: str, job: Job | None) -> Standing:
    """How the run of a job is, or the run of that name. RunError where there is neither."""
    if job is None:
        return Standing(job=None, status=statuses.status(catalog.open_run(root, name)))
    return Standing(job=line(job), status=launchers.serving(job).status(job))


def named(name: str, job: Job | None, known: Iterable[Job]) -> Job:
    """A job that was looked for. ConfigError that names the jobs there are where it was not found."""
    if job is None:
        names = ", ".join(other.name for other in known) or "none; submit one with t6gps submit"
        raise ConfigError(f"there is no job {name!r}; jobs: {names}")
    return job


def scale(root: Path, name: str, job: Job | None, workers: int, deadline_s: float) -> Status:
    """Give a running run so many workers; its status then. RunError as `requests.scale`."""
    if job is None:
        return requests.scale(catalog.open_run(root, name), workers, deadline_s)
    return launchers.serving(job).scale(job, workers, deadline_s)


def stop(root: Path, name: str, job: Job | None, deadline_s: float, warn: Callable[[str], object]) -> str:
    """Stop a run as Ctrl-C does, wait until it has ended, and say how it is; everything sampled is kept.

    A job that does not stop by the deadline is ended, of which `warn` is told. RunError where there is nothing to stop,
    or where it does not end.
    """
    if job is None:
        return _stop_run(catalog.open_run(root, name), deadline_s)
    launcher = launchers.serving(job)
    state, _ = launcher.state(job)
    if state in ENDED:
        if catalog.exists(Path(job.root), job.run):
            run = catalog.open_run(Path(job.root), job.run)
            if catalog.process_of(run) is not None:  # somebody has resumed it without a job
                return _stop_run(run, deadline_s)
        raise RunError(f"job {job.name} is {state} already; there is nothing to stop")
    launcher.stop(job)
    ended = _ended(launcher, job, deadline_s)
    if ended is None:
        warn(f"job {job.name} has not stopped within {deadline_s:.0f} s; it is ended")
        launcher.cancel(job)
        ended = _ended(launcher, job, CANCEL_S)
    if ended is None:
        raise RunError(f"job {job.name} ({job.kind} {job.native_id}) does not end; see its target")
    return f"job {job.name} is {ended}" + ("; --resume continues it" if ended is JobState.STOPPED else "")


def _stop_run(run: Run, deadline_s: float) -> str:
    return f"run {run.name}: {requests.stop(run, deadline_s)}"


def _ended(launcher: Launcher, job: Job, deadline_s: float) -> JobState | None:
    """How a job ended, None where it has not by the deadline."""
    deadline = time.monotonic() + deadline_s
    while time.monotonic() < deadline:
        state, _ = launcher.state(job)
        if state in ENDED:
            return state
        time.sleep(TICK_S)
    return None
