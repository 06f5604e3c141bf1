"""The robot in the episodes of a job, as an environment of Gymnasium, and the job's policy for its observations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from t6gps.service.bench.contenders import Job
from t6gps.workers.environment import SuperBallEnvironment
from t6gps.workers.episode import exploration, policy
from t6gps.workers.settings import RobotSettings

Floats = NDArray[np.float32]


class PlannedEnvironment(gymnasium.Wrapper[Floats, Floats, Floats, Floats]):
    """The robot in the episodes of a job, from number `first` on in steps of `job.workers`, explored as planned."""

    def __init__(self, job: Job, first: int) -> None:
        settings = job.config.rollout
        super().__init__(TimeLimit(SuperBallEnvironment(settings.robot, settings.task, settings.terrain), job.steps))
        self._plans = iter(job.plans[first :: job.workers])
        self._correlation = settings.exploration.noise_correlation
        self._half_range_m = _scale(settings.robot)[1]
        self._noise: Iterator[NDArray[np.float64]] = iter(())

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Start the next episode of the job, whatever `seed` says."""
        plan = next(self._plans)
        rng = np.random.default_rng(plan.seed)
        self._noise = iter(exploration.noise(rng, plan.noise_std_m, self._correlation, plan.steps))
        return self.env.reset(seed=plan.seed, options={"terrain_seed": plan.terrain_seed})

    def step(self, action: Floats) -> tuple[Floats, Any, bool, bool, dict[str, Any]]:
        """Take a control step with the action and its share of noise."""
        explored = np.clip(action + next(self._noise) / self._half_range_m, -1.0, 1.0)
        return self.env.step(explored.astype(np.float32))


def _scale(robot: RobotSettings) -> tuple[float, float]:
    """Rest lengths of actions 0 and 1 above it (m)."""
    return (
        (robot.longest_command_m + robot.shortest_command_m) / 2,
        (robot.longest_command_m - robot.shortest_command_m) / 2,
    )


class Actor:
    """The job's policy, from observations [n, 83] to actions [n, 24] of the environment."""

    def __init__(self, job: Job) -> None:
        self._middle_m, self._half_range_m = _scale(job.config.robot)
        self._act = policy.ready(job.snapshot)

    def __call__(self, observations: Floats) -> Floats:
        commands = np.array([self._act(observation) for observation in np.ascontiguousarray(observations)])
        return ((commands - self._middle_m) / self._half_range_m).astype(np.float32)
