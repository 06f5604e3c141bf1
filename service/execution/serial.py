"""One worker and the learner in this process, and how both are made from a configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from t6gps.learner.learner import Learner
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.pool.attempt import Failure, attempt
from t6gps.storage import spool
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import CONTROL_STEP_S, Engine
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.symmetry import CABLE_MAP, PROPER
from t6gps.workers.settings import RobotSettings
from t6gps.workers.worker import RolloutWorker

ACTION_SCALE_M = 0.2
"""Rest length per unit of the policy's output (m)."""


class SerialExecutor(Executor):
    """One worker and the learner in this process: for debugging, tests and `--serial`."""

    def __init__(
        self,
        config: Config,
        run: Run | None = None,
        simulation: Callable[[RobotSettings], Engine] = PyBulletEngine,
    ) -> None:
        super().__init__(config, run)
        self._worker = RolloutWorker(config.rollout, simulation)
        self.replace_learner()

    def sample(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: str = "episode"
    ) -> Iterator[Episode]:
        self._open(plans, snapshot, purpose)
        while (plan := self.ledger.lease(0, 0)) is not None:
            result = attempt(self._worker, plan, snapshot)
            if isinstance(result, Failure):
                if self.ledger.fail(plan, result):
                    self._quarantine(plan)
                if self.ledger.hopeless:
                    raise RunError(f"nothing but failures comes back; the last: episode {plan.episode_id}: {result}")
                continue
            self.ledger.arrive(plan)
            yield result
            self.ledger.commit(plan.episode_id)

    def sample_ahead(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Callable[[Episode], None]
    ) -> None:
        """Nothing runs beside the learner here: all plans are left to `sample`."""

    def hand_over(self, kept: Sequence[Path]) -> None:
        for path in kept:
            self._learner.add(spool.read(path).frames)

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        yield from getattr(self._learner, phase)()

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._learner, method)(*arguments)

    def replace_learner(self) -> None:
        self._learner = new_learner(self.config)

    def close(self) -> None:
        self._worker.close()


def new_learner(config: Config, **options: Any) -> Learner:
    """The learner of a run, with its first policy."""
    robot = config.robot
    return Learner(
        config.learner,
        run_seed=config.run.seed,
        target_speed_m_per_s=config.task.target_speed_m_per_s,
        vertical_weight=config.task.vertical_weight,
        command_range_m=(robot.shortest_command_m, robot.longest_command_m),
        offset_m=nominal_rest_length(robot),
        scale_m=ACTION_SCALE_M,
        reach_m=robot.winch_speed_m_per_s * CONTROL_STEP_S,
        world_labels=CABLE_MAP,
        mirrored=~PROPER,
        keeps_earlier=config.run.pipelined,
        **options,
    )
