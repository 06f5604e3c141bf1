"""What the training loop needs of its workers and its learner.

`serial` runs them in this process, `actors` spreads the same two classes over a Ray cluster; both give the same bytes.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from t6gps.service.config import Config
from t6gps.service.pool import crash_bundle
from t6gps.service.pool.ledger import Ledger
from t6gps.storage.catalog import Run
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

PHASES = ("segment", "fit", "backward_pass", "supervise")
"""Phases of the learner in their order (paper Alg. 2, lines 3, 4-7, 8-12 and 13)."""
_log = logging.getLogger(__name__)


class Executor(ABC):
    """Rollout workers and one learner, wherever they run.

    run       whose folder keeps crash bundles and status; None where nothing is to be kept
    finished  set when the work is done: what is closed then is not stopped half-way
    ledger    the episodes of the present call of `sample` or `sample_ahead`, and the counters of the whole run
    """

    def __init__(self, config: Config, run: Run | None = None) -> None:
        self.config, self.run = config, run
        self.finished = False
        self.ledger = Ledger()
        self._purpose = "episode"
        self._snapshots: dict[int, PolicySnapshot] = {}

    @abstractmethod
    def sample(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: str = "episode"
    ) -> Iterator[Episode]:
        """Begin to run the plans with the policy; yields each episode when it is done, in any order.

        Whoever asks for the next episode has made the last one durable. An episode that fails three times is left
        out and kept as a crash bundle named after `purpose`; RunError when nothing but failures comes back.
        """

    @abstractmethod
    def sample_ahead(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Callable[[Episode], None]
    ) -> None:
        """Let the workers begin with plans while the learner works; `keep` makes each episode durable.

        It ends with the next call of `sample`, which is given the plans that are still missing.
        """

    @abstractmethod
    def hand_over(self, kept: Sequence[Path]) -> None:
        """Give the learner an iteration's episodes, by their files in the spool: it reads them where they lie."""

    @abstractmethod
    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        """Run one of PHASES; yields (done, total)."""

    @abstractmethod
    def ask(self, method: str, *arguments: Any) -> Any:
        """Call a method of the learner: `policy`, `report`, `state`, `restore` or `recall`."""

    @abstractmethod
    def replace_learner(self) -> None:
        """Start another learner in the place of one that died; it knows nothing."""

    @abstractmethod
    def close(self) -> None:
        """Stop every worker and the learner, at once. A second call does nothing."""

    def _open(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: str) -> None:
        self._purpose = purpose
        self._snapshots = {snapshot.version: snapshot}
        left_out = crash_bundle.kept(self.run.bundles, purpose) if self.run else set()
        self.ledger.open(plans, left_out.intersection(plan.episode_id for plan in plans))

    def _quarantine(self, plan: EpisodePlan) -> None:
        """Keep what is needed to find out why the episode fails."""
        failures = self.ledger.failures[plan.episode_id]
        _log.warning(
            "%s %d is left out after %d failures: %s", self._purpose, plan.episode_id, len(failures), failures[-1]
        )
        if self.run is not None:
            snapshot = self._snapshots[plan.policy_version]
            crash_bundle.write(self.run.bundles, self._purpose, plan, self.config.rollout, snapshot, failures)
