"""A study's run: study, arm and seed, commits that worked on it, and the time they took, in a file of the run."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from pydantic import TypeAdapter

from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

FILE = "study.json"
EARLIER_FILE = "origin.json"
"""Where versions up to 0.2.0 kept it; `training.origin` has another record there."""


@dataclass(frozen=True)
class Origin:
    """A study's run: its place in the study, the commits that worked on it, their seconds, the cores of the machine.

    All but the commits are None where no study has worked on the run.
    """

    study: str | None = None
    arm: str | None = None
    seed: int | None = None
    commits: tuple[str, ...] = ()
    wall_s: float | None = None
    cores: int | None = None


_ORIGIN = TypeAdapter(Origin)


def origin(run: Run) -> Origin:
    """The origin of a run, as its file has it. RunError where that cannot be read."""
    for path in (run.path / FILE, run.path / EARLIER_FILE):
        try:
            record = durable.parsed(path.read_bytes()) if path.exists() else {}
            if not isinstance(record, dict):
                raise TypeError(f"it must hold an object, found a {type(record).__name__}")
            if "study" in record:
                return _ORIGIN.validate_python(record)
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split())
            raise RunError(
                f"run {run.name} is not whole: cannot read {path}: {reason}; restore it from a copy"
            ) from None
    return Origin()


@contextmanager
def recorded(run: Run, study: str, arm: str, seed: int, commit: str) -> Iterator[None]:
    """Add the commit and the time of what runs inside to the run's origin, also when it is interrupted."""
    before, start = origin(run), time.perf_counter()
    commits = before.commits if commit in before.commits else (*before.commits, commit)

    def keep() -> None:
        wall_s = round((before.wall_s or 0.0) + time.perf_counter() - start, 1)
        record = Origin(study, arm, seed, commits, wall_s, os.cpu_count())
        path = run.path / FILE
        durable.hidden(path).write_text(json.dumps(asdict(record), indent=2) + "\n")
        durable.publish(path)

    keep()
    try:
        yield
    finally:
        keep()
