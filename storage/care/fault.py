"""What verifying a run finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from t6gps.storage.catalog import Run

Progress = Callable[[int, int], object]
"""Is told the files that have been looked at, and all."""


@dataclass(frozen=True)
class Fault:
    """Something of a run that is not as it was written.

    part         a table, or checkpoints, spool, config, origin, study, ground, evaluation
    place        its file or folder, by its path in the run
    what         what is wrong with it
    number       the iteration, or of tables of evaluations the evaluation, that it belongs to; None where to none
    repairable   `t6gps repair` mends it without a copy, and loses nothing that resuming does not make again
    """

    part: str
    place: str
    what: str
    number: int | None = None
    repairable: bool = False

    def __str__(self) -> str:
        return f"{self.part}: {self.place}: {self.what}"


def within(run: Run, path: Path) -> str:
    """A path as faults have it."""
    return path.relative_to(run.path).as_posix()
