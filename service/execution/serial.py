"""One worker and the learner in this process: for debugging, tests and `--serial`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from t6gps.learner.learner import Learner
from t6gps.learner.phases import Phase
from t6gps.learner.port import Progress
from t6gps.service import logs, threads
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor, Keep, Purpose
from t6gps.service.execution.wiring import new_learner
from t6gps.service.logs import Role
from t6gps.service.pool.attempt import Failure, attempt
from t6gps.service.pool.state import RunState
from t6gps.storage import spool
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Engine
from t6gps.workers.settings import RobotSettings
from t6gps.workers.worker import RolloutWorker


class SerialExecutor(Executor):
    """One worker and the learner, which take turns.

    Libraries compute with one thread in this process until `close`, so that data do not depend on the caller.
    """

    def __init__(
        self,
        config: Config,
        run: Run | None = None,
        simulation: Callable[[RobotSettings], Engine] = PyBulletEngine,
    ) -> None:
        super().__init__(config, run)
        with ExitStack() as started:
            started.callback(threads.limit())
            self._worker = RolloutWorker(config.rollout, simulation)
            started.callback(self._worker.close)
            self.replace_learner()
            self._held = started.pop_all()

    @property
    def learner(self) -> Learner:
        return self._learner

    def sample(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        keep: Keep,
        purpose: Purpose = Purpose.TRAINING,
    ) -> None:
        self.ledger.open(plans, self._open(plans, snapshot, purpose))
        while (plan := self.ledger.lease(0, 0)) is not None:
            with logs.speaking(logs.other(Role.WORKER, slot=0, episode=plan.episode_id)):
                result = attempt(self._worker, plan, snapshot)
            if isinstance(result, Failure):
                if self.ledger.fail(plan, result):
                    self._quarantine(plan)
                if self.ledger.hopeless:
                    raise RunError(f"nothing but failures comes back; the last: episode {plan.episode_id}: {result}")
                continue
            self.ledger.arrive(plan)
            keep(result)
            self.ledger.commit(plan.episode_id)

    def sample_ahead(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Keep) -> None:
        """Nothing runs beside the learner here: all plans are left to `sample`."""

    def feed(self, episode: Episode) -> None:
        self._learner.add(episode.frames, episode.noise_std_m)

    def feed_spooled(self, files: Sequence[Path]) -> None:
        for file in files:
            self.feed(spool.read(file))

    def learn(self, phase: Phase) -> Progress:
        yield from getattr(self._learner, phase.name)()

    def replace_learner(self) -> None:
        self._learner = new_learner(self.config)

    def tend(self, phase: str | None = None) -> None:
        """Nothing runs beside the caller here."""

    def close(self, outcome: RunState = RunState.STOPPING) -> None:
        self._held.close()
