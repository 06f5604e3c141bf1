"""What the training loop needs of its workers and its learner.

`serial` runs them in this process, `ray_executor` spreads the same two classes over a Ray cluster; both give the same
bytes.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path

from t6gps.learner.phases import Phase
from t6gps.learner.port import LearnerPort, Progress
from t6gps.service.config import Config
from t6gps.service.pool import crash_bundle
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.state import RunState
from t6gps.storage.catalog import Run
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

Keep = Callable[[Episode], None]
"""Makes an episode durable: when it returns, the episode survives a crash and counts."""
_log = logging.getLogger(__name__)


class Purpose(StrEnum):
    """What episodes are for; crash bundles are named after it."""

    TRAINING = "episode"
    EVALUATION = "evaluation"


class Executor(ABC):
    """Rollout workers and one learner, wherever they run.

    run       whose folder keeps crash bundles and status; None where nothing is to be kept
    ledger    the episodes of the present batch, and the counters of the whole run
    """

    def __init__(self, config: Config, run: Run | None = None) -> None:
        self.config, self.run = config, run
        self.ledger = Ledger()
        self._purpose = Purpose.TRAINING
        self._snapshots: dict[int, PolicySnapshot] = {}

    @property
    @abstractmethod
    def learner(self) -> LearnerPort:
        """The learner, started when it is first needed; LearnerDiedError when its process is gone."""

    @abstractmethod
    def sample(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        keep: Keep,
        purpose: Purpose = Purpose.TRAINING,
    ) -> None:
        """Run the plans with the policy, and `keep` each episode when it is done, in any order.

        An episode that fails three times is quarantined and kept as a crash bundle; RunError when nothing but failures
        comes back.
        """

    @abstractmethod
    def sample_ahead(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Keep) -> None:
        """Let the workers begin with training plans while the learner works; `keep` makes each episode durable.

        It ends with the next call of `sample`, which is given the plans that are still missing.
        """

    @abstractmethod
    def feed(self, episode: Episode) -> None:
        """Give the learner an episode that `sample` has just handed over; it works on it while others are sampled.

        What goes wrong with it is raised by the next phase of the learner.
        """

    @abstractmethod
    def feed_spooled(self, files: Sequence[Path]) -> None:
        """Give the learner episodes that lie in the spool already: sampled ahead, or before a restart."""

    @abstractmethod
    def learn(self, phase: Phase) -> Progress:
        """Run a phase of the learner; yields (done, total)."""

    @abstractmethod
    def replace_learner(self) -> None:
        """Start another learner in the place of one that died; it knows nothing."""

    @abstractmethod
    def tend(self, phase: str | None = None) -> None:
        """Let the workers be looked after, where whoever calls is at other work for long: `phase`, for the status."""

    @abstractmethod
    def close(self, outcome: RunState = RunState.STOPPING) -> None:
        """Stop every worker and the learner, at once; the run is DONE or STOPPING. A second call does nothing."""

    def _open(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: Purpose) -> list[int]:
        """Note what a batch is for; its episodes that are in quarantine."""
        self._purpose = purpose
        self._snapshots = {snapshot.version: snapshot}
        quarantined = crash_bundle.kept(self.run.bundles, purpose) if self.run else set()
        return sorted(quarantined.intersection(plan.episode_id for plan in plans))

    def _quarantine(self, plan: EpisodePlan) -> None:
        """Keep what is needed to find out why the episode fails."""
        failures = self.ledger.failures[plan.episode_id]
        _log.warning(
            "%s %d is quarantined after %d failures: %s",
            self._purpose,
            plan.episode_id,
            len(failures),
            failures[-1],
            extra={"episode": plan.episode_id},
        )
        if self.run is not None:
            snapshot = self._snapshots[plan.policy_version]
            crash_bundle.write(self.run.bundles, self._purpose, plan, self.config.rollout, snapshot, failures)
