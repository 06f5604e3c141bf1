"""The robot as the rivals learn on it: a Gymnasium environment whose episodes are those of T6-GPS's training.

`workers.environment` is the one for strangers; this one sees and earns what `senses` says, and tells in `info` how
frames lie in the world, so that `headings` can turn the waypoint afterwards.
"""

from __future__ import annotations

from itertools import count
from typing import Any

import gymnasium
import numpy as np

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.studies.rivals.senses import SENSES_N, Actions, Floats, command, reward, senses
from t6gps.storage.errors import UnsoundStateError
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Unique
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.symmetry import CABLE_MAP, PROPER
from t6gps.workers.robot.topology import CABLES_N

Info = dict[str, Any]
FRAMES = "frames"
"""In `info`: turn (rad) and side of the frames before and after the step [4]; in the frame of a row, a horizontal
direction of the world has the angle turn + side * angle."""


class RivalEnvironment(Unique, gymnasium.Env[Floats, Floats]):
    """Episodes of training, in their order and without end; a state out of range ends one, at rest for ever (r = 0)."""

    def __init__(self, config: Config, actions: Actions) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SENSES_N,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (CABLES_N,))
        self._settings, self._actions = config.rollout, actions
        self._plans = (plan for number in count() for plan in seeding.training_plans(config, number))
        self._nominal_m = nominal_rest_length(config.robot)
        self._engine = PyBulletEngine(config.robot)
        self._last_step = config.run.steps

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Begin the next episode; its plan decides everything, `seed` nothing."""
        plan = next(self._plans)
        self._episode = RunningEpisode(
            self._engine,
            self._settings,
            plan.seed,
            plan.terrain_seed,
            plan.terrain_difficulty,
            self._nominal_m,
            number=plan.index,
        )
        self._step = 0
        self._seen = senses(self._episode)
        return self._seen, {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, Info]:
        """Take one control step."""
        episode, before = self._episode, _frame(self._episode)
        wanted = command(self._actions, action, episode, self._settings.robot)
        self._step += 1
        try:
            episode.advance(wanted[CABLE_MAP[episode.frame.element]])
        except UnsoundStateError:
            return self._seen, 0.0, True, False, {FRAMES: before * 2}
        self._seen = senses(episode)
        earned = float(reward(episode.state.com_velocity, np.array(episode.target), self._settings.task))
        return self._seen, earned, False, self._step == self._last_step, {FRAMES: before + _frame(episode)}

    def close(self) -> None:
        """Release the simulator."""
        self._engine.close()


def _frame(episode: RunningEpisode) -> tuple[float, float]:
    return episode.yaw_rad, 1.0 if PROPER[episode.frame.element] else -1.0
