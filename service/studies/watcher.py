"""Who watches a study: the sentences it says, and the progress of the run at work."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from t6gps.service.training.loop import Observer

Progress = Callable[[int, int], None]
"""Takes how much is done, and how much there is in all."""


class Watcher(Protocol):
    """Whoever watches a study."""

    def say(self, sentence: str) -> None:
        """What comes next, and how long it takes."""

    def warn(self, sentence: str) -> None:
        """What may spoil the comparison."""

    def run(self, iterations: int) -> AbstractContextManager[Observer]:
        """The observer of a run with that number of iterations, while it is trained or evaluated."""

    def task(self, title: str) -> AbstractContextManager[Progress]:
        """Takes the progress of work that has no phases."""
