"""One worker and the learner in this process, and how both are made from a configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from t6gps.learner.learner import Learner
from t6gps.service.config import Config
from t6gps.service.executor import Executor
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.physics import Simulation, nominal_rest_length
from t6gps.workers.settings import RobotSettings
from t6gps.workers.worker import RolloutWorker

ACTION_SCALE_M = 0.2
"""Rest length per unit of the policy's output (m)."""


class SerialExecutor(Executor):
    """One worker and the learner in this process: for debugging, tests and `--serial`."""

    def __init__(self, config: Config, simulation: Callable[[RobotSettings], Simulation] = Simulation) -> None:
        self._worker = RolloutWorker(config.rollout, simulation)
        self._learner = new_learner(config)

    def sample(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot) -> Iterator[Episode]:
        for plan in plans:
            yield self._worker.run(plan, snapshot)

    def add(self, episode: Episode) -> None:
        self._learner.add(episode.frames)

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        yield from getattr(self._learner, phase)()

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._learner, method)(*arguments)

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
        **options,
    )
