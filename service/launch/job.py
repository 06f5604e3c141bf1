"""Jobs that this user has submitted: a file of each, STATE/jobs/NAME.json, in the user's folder of states.

STATE is T6GPS_STATE, else XDG_STATE_HOME/t6gps, else ~/.local/state/t6gps.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict, JsonValue, ValidationError

from t6gps.service import logs
from t6gps.service.launch import state
from t6gps.service.launch.folder import Folder
from t6gps.service.launch.target import Kind
from t6gps.storage import catalog, durable
from t6gps.storage.errors import RunError


class JobState(StrEnum):
    """How a job is. The last three do not change any more."""

    PENDING = "pending"
    RUNNING = "running"
    DONE = "done"
    STOPPED = "stopped"
    FAILED = "failed"


ENDED = (JobState.DONE, JobState.STOPPED, JobState.FAILED)
STOPPED = 130
OUTCOMES = {0: JobState.DONE, STOPPED: JobState.STOPPED}
"""What exit codes of a job mean; all others mean that it failed."""


class Job(BaseModel):
    """A job: where it runs and under which number there, which run it trains, and where that run lies.

    submitted   UTC in ISO 8601
    target      the settings of its target, as they were
    """

    model_config = ConfigDict(frozen=True)

    name: str
    kind: Kind
    native_id: str
    run: str
    root: str
    source: str
    submitted: str
    target: dict[str, JsonValue]

    @property
    def folder(self) -> Folder:
        """The job's folder in its root."""
        return Folder(Path(self.root) / ".jobs" / self.run)


def outcome(folder: Folder) -> tuple[JobState, str]:
    """How a job ended that is no longer there, and what its log said last."""
    code = folder.exit_code
    if code is None and not folder.log.exists():
        return JobState.FAILED, f"ended without a word or a log; let its nodes share the root {folder.root}"
    if code is None:
        return JobState.FAILED, f"ended without a word, killed or lost; see {folder.log}, resume with --resume"
    state = OUTCOMES.get(code, JobState.FAILED)
    return state, last_words(folder) if state is JobState.FAILED else ""


def last_words(folder: Folder) -> str:
    """The last line of a job's log that says something."""
    try:
        lines = folder.log.read_text(errors="replace").split("\n")
    except OSError:
        return f"it has no log {folder.log}"
    return next((logs.said(line.strip()) for line in reversed(lines) if line.strip()), "its log is empty")


def make_state_folder() -> None:
    """Make the user's folder of jobs when it is missing. RunError where it cannot be written."""
    folder = state.folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(f"no permission to write in {folder}")
    except OSError as error:
        raise RunError(
            f"cannot keep records of jobs in {folder}: {error}; set T6GPS_STATE to a folder that can be written"
        ) from None


def new(kind: Kind, native_id: str, folder: Folder, source: str, target: BaseModel) -> Job:
    """Record a job that was submitted now, in the place of an earlier job of the same run; the record."""
    job = record(_free_name(folder), kind, native_id, folder, source, target)
    path = state.folder() / f"{job.name}.json"
    durable.hidden(path).write_text(job.model_dump_json(indent=2) + "\n")
    durable.publish(path)
    return job


def record(name: str, kind: Kind, native_id: str, folder: Folder, source: str, target: BaseModel) -> Job:
    """The record of a job that was submitted now; it is not kept yet."""
    return Job(
        name=name,
        kind=kind,
        native_id=native_id,
        run=folder.run,
        root=str(folder.root),
        source=source,
        submitted=datetime.now(UTC).isoformat(),
        target=target.model_dump(mode="json", exclude_none=True),
    )


def forget(jobs: Iterable[Job]) -> None:
    """Remove the records of jobs."""
    for job in jobs:
        (state.folder() / f"{job.name}.json").unlink(missing_ok=True)


def _free_name(folder: Folder) -> str:
    """The run's name, with a number where a run of another root has taken it."""
    taken = {job.name: job for job in jobs()}
    for name in itertools.chain([folder.run], (f"{folder.run}-{number}" for number in itertools.count(2))):
        other = taken.get(name)
        if other is None or (other.run == folder.run and other.root == str(folder.root)):
            return name
    raise AssertionError("numbers do not end")


def jobs() -> list[Job]:
    """All jobs, the newest last. RunError for a record that cannot be read."""
    return sorted(_records(), key=lambda job: job.submitted)


def _records() -> Iterator[Job]:
    for path in state.folder().glob("[!.]*.json"):
        try:
            yield Job.model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            reason = " ".join(str(error).split())
            raise RunError(f"cannot read the record {path} of a job: {reason}; correct or remove the file") from None


def of_root(root: Path) -> list[Job]:
    """The jobs that train runs of a root, the newest last."""
    whole = catalog.whole(root)
    return [job for job in jobs() if Path(job.root) == whole]


def training(root: Path, run: str) -> Job | None:
    """The job that trains a run of a root, None where there is none."""
    return next((job for job in of_root(root) if job.run == run), None)


def find(root: Path, name: str) -> Job | None:
    """The job that trains the run `name` of a root; else, where that root has no such run, the job of that name."""
    job = training(root, name)
    if job is not None or catalog.exists(root, name):
        return job
    return next((job for job in jobs() if job.name == name), None)
