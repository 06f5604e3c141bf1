"""A replay buffer that turns the waypoint: half of what it samples is as if it lay in a random direction.

Physics does not know the waypoint, so both ends of a transition and its reward can be written for any direction. The
action value of T6-GPS learns in the same way (`learner.improvers.action_value`).
"""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from t6gps.service.studies.rivals.environment import FRAMES, Info
from t6gps.service.studies.rivals.senses import VELOCITY, Array, reward
from t6gps.storage.schema import TARGET
from t6gps.workers.settings import TaskSettings

OWN_HEADING_SHARE = 0.5
"""Share of transitions that keep their own waypoint."""


class HeadingBuffer(ReplayBuffer):
    """Transitions of one `RivalEnvironment`."""

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        device: torch.device | str = "cpu",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        task: TaskSettings,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, optimize_memory_usage)
        self._task, self._rng = task, rng
        self._frames = np.zeros((self.buffer_size, 4))

    def add(self, obs: Array, next_obs: Array, action: Array, reward: Array, done: Array, infos: list[Info]) -> None:
        """Keep a transition, and how its frames lie in the world."""
        self._frames[self.pos] = infos[0][FRAMES]
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: Array, env: VecNormalize | None = None) -> ReplayBufferSamples:
        samples = super()._get_samples(batch_inds, env)
        turned = np.flatnonzero(self._rng.random(len(batch_inds)) >= OWN_HEADING_SHARE)
        heading = self._rng.uniform(-np.pi, np.pi, len(turned))
        turn, side, next_turn, next_side = self._frames[batch_inds[turned]].T
        seen, following = samples.observations.numpy(), samples.next_observations.numpy()
        seen[turned, TARGET] = _direction(turn + side * heading)
        direction = _direction(next_turn + next_side * heading)
        following[turned, TARGET] = direction
        earned = reward(following[turned, VELOCITY], direction, self._task)
        ended = samples.dones.numpy()[turned, 0] > 0  # at rest for ever, whatever the heading
        samples.rewards[turned, 0] = torch.from_numpy(np.where(ended, 0.0, earned).astype(np.float32))
        return samples


def _direction(angle: Array) -> Array:
    """Unit vectors [n, 2] of angles [n] (rad)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
