"""The port of the rivals: each learns within a budget of control steps and gives back a controller at each mark."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Protocol

from t6gps.service.config import Config
from t6gps.service.studies.watcher import Progress
from t6gps.workers.episode.rollout import Controller


@dataclass(frozen=True)
class Trained:
    """A controller without noise after a number of control steps; it holds until the next one is asked for."""

    steps: int
    control: Controller


class Train(Protocol):
    """A way of learning."""

    def __call__(self, config: Config, marks: Sequence[int], progress: Progress) -> Generator[Trained]:
        """Learn, and yield what is learned at each of the rising marks, with that many steps at most.

        The seed of the configuration decides everything, on one machine.
        """
