"""What the training loop needs of its workers and its learner.

`serial` runs them in this process, `actors` spreads the same two classes over a Ray cluster; both give the same bytes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

PHASES = ("segment", "fit", "backward_pass", "supervise")
"""Phases of the learner in their order (paper Alg. 2, lines 3, 4-7, 8-12 and 13)."""


class Executor(ABC):
    """Rollout workers and one learner, wherever they run."""

    @abstractmethod
    def sample(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot) -> Iterator[Episode]:
        """Run the plans with at least the snapshot's version; yields each episode when it is done, in any order."""

    @abstractmethod
    def add(self, episode: Episode) -> None:
        """Hand an episode to the learner."""

    @abstractmethod
    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        """Run one of PHASES; yields (done, total)."""

    @abstractmethod
    def ask(self, method: str, *arguments: Any) -> Any:
        """Call a method of the learner: `policy`, `report`, `state` or `restore`."""

    @abstractmethod
    def close(self) -> None:
        """Stop every worker and the learner, at once."""
