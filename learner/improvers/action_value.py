"""A learned action value, by which actions can be improved (beyond the paper): it sees farther than local models reach.

    Q(s, e) = E[ sum_k gamma^k r[k+1] ]     r = -cost / (2 v*), less its mean: as the forward speed, in m/s
    e = clip((u - rest lengths) / reach, -1, 1)      reach: the farthest that a winch comes in a control step

s holds the observation and the velocities of centre of mass and nodes. Most commands lie farther from the rest lengths
than the winches reach in a step; e is all that they do in it. Q is a network, learned by temporal differences from the
transitions of several iterations, whatever policy made them: in the next state the newest policy acts (fitted Q
evaluation). Physics does not know the waypoint, so half of the transitions are learned from as if it lay in a random
direction, which both ends of the transition see and to which the cost refers.

Improved actions climb Q from the policy's own within a penalty on the distance,

    u* = argmax_u  Q(s, e(u)) - |u - u0|^2 / (2 w)

A command beyond the reach of its winch changes nothing in this step and stays.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from t6gps.learner import cost, policy
from t6gps.learner.algorithm import supervised
from t6gps.learner.improvers.transitions import INPUTS_N, MOVED, Transitions, joined
from t6gps.learner.port import Arrays
from t6gps.learner.rows import AnyArray, Floats, Ints, pieces
from t6gps.learner.settings import ActionValueSettings
from t6gps.storage.records import PolicySnapshot

PREPARED_N = 30
"""Gradient steps whose transitions are prepared at once."""


class ActionValue:
    """Q of the newest policy, and the transitions that it is learned from.

    target_speed_m_per_s, vertical_weight   v* of the cost and weight of the vertical velocity in it
    """

    def __init__(
        self,
        settings: ActionValueSettings,
        target_speed_m_per_s: float,
        vertical_weight: float,
        rng: np.random.Generator,
    ) -> None:
        self._settings = settings
        self._target_speed_m_per_s, self._vertical_weight = target_speed_m_per_s, vertical_weight
        first = policy.initial(INPUTS_N, 1, settings.hidden_layers, rng, offset_m=0.0, scale_m=1.0)
        self._vector, self._layers = policy.parameters(first)
        self._target, self._target_layers = policy.parameters(first)
        self._moments = supervised.no_moments(self._vector)
        self._remembered: deque[Transitions] = deque(maxlen=settings.remembered_iterations)

    @property
    def steps_n(self) -> int:
        """Gradient steps that `learn` will take."""
        return self._settings.steps if self._moments.step else self._settings.first_steps

    def add(self, transitions: Transitions) -> None:
        """Take the transitions of one iteration; those of the oldest go."""
        self._remembered.append(transitions)

    def file_away(self) -> None:
        """Let go of the memory of the newest transitions, if they are many; their iteration is over."""
        self._remembered.append(self._remembered.pop().filed())

    def learn(self, snapshot: PolicySnapshot, rng: np.random.Generator) -> Iterator[None]:
        """Take `steps_n` gradient steps towards the value of a policy; yields after each."""
        torch.set_num_threads(1)
        known, batch_n = joined(self._remembered), self._settings.batch
        index = np.flatnonzero(known.acts)
        mean = self._mean_reward(known, index)
        act = _actor(snapshot)
        for prepared_n in _portions(self.steps_n):
            rows = rng.choice(index, prepared_n * batch_n)
            anywhere = rng.uniform(-np.pi, np.pi, len(rows)).astype(np.float32)
            heading = np.where(rng.random(len(rows)) < self._settings.own_heading_share, known.heading[rows], anywhere)
            direction = known.direction(rows + 1, heading)
            before, _ = known.take(rows, known.direction(rows, heading))
            after, rest_lengths = known.take(rows + 1, direction)
            after[:, MOVED] = _moved(act(after), rest_lengths, known.reach_m)
            reward = torch.from_numpy(self._reward(known, rows + 1, direction) - mean)
            prepared = (part.view(prepared_n, batch_n, -1) for part in (before, after, reward))
            for batch in zip(*prepared, strict=True):
                self._step(*batch)
                yield

    def _step(self, before: torch.Tensor, after: torch.Tensor, reward: torch.Tensor) -> None:
        """One gradient step on transitions: [s; e] before and after [m, ni], and the reward [m, 1]."""
        settings = self._settings
        wanted = policy.activations(self._target_layers, after)[-1].mul_(settings.discount).add_(reward)
        change = supervised.gradient(self._layers, before, wanted, len(before))
        supervised.descend(self._vector, change, self._moments, settings.learning_rate, settings.weight_decay)
        self._target.lerp_(self._vector, settings.target_rate)

    def improved(self, snapshot: PolicySnapshot) -> Floats:
        """u* [n, nu] (m) at the rows of the newest transitions."""
        torch.set_num_threads(1)
        newest, act, settings = self._remembered[-1], _actor(snapshot), self._settings

        def climb(rows: Ints) -> torch.Tensor:
            inputs, rest_lengths = newest.take(rows)
            start = act(inputs)
            command = start.clone()
            for _ in range(settings.ascents):
                inputs[:, MOVED] = _moved(command, rest_lengths, newest.reach_m)
                wanted = start + settings.step_weight * self.slope(inputs, newest.reach_m)
                command += settings.ascent_rate * (wanted - command)
            return command

        n = len(newest.acts)
        parts = np.split(np.arange(n), range(policy.ROWS, n, policy.ROWS))
        climbed = np.empty((n, MOVED.stop - MOVED.start), dtype=np.float32)
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            for rows, command in zip(parts, threads.map(climb, parts), strict=True):
                climbed[rows] = command.numpy()
        return climbed

    def _mean_reward(self, known: Transitions, index: Ints) -> np.float32:
        """Mean reward over the rows after those that act [m]."""
        rewards = [
            self._reward(known, rows + 1, known.direction(rows + 1, known.heading[rows])) for rows in pieces(index)
        ]
        mean: np.float32 = np.concatenate(rewards).mean()
        return mean

    def _reward(self, known: Transitions, rows: Ints, direction: Floats) -> Floats:
        """-cost / (2 v*) in rows [m] (m/s)."""
        speed = self._target_speed_m_per_s
        spent = cost.running_cost(known.com_velocity[rows], direction, speed, self._vertical_weight)
        return (spent / (-2 * speed)).astype(np.float32)

    def values(self, inputs: torch.Tensor) -> torch.Tensor:
        """Q [m] of inputs [s; e] [m, ni] (m/s)."""
        return policy.activations(self._layers, inputs)[-1][:, 0]

    def gradient(self, inputs: torch.Tensor) -> torch.Tensor:
        """dQ/de [m, nu] (m/s) at inputs [s; e] [m, ni]."""
        values = policy.activations(self._layers, inputs)
        back = self._layers[-1][0].expand(len(inputs), -1)
        for number in reversed(range(len(self._layers) - 1)):
            back = torch.ops.aten.tanh_backward(back, values[number + 1]) @ self._layers[number][0]
        return back[:, MOVED]

    def slope(self, inputs: torch.Tensor, reach_m: float) -> torch.Tensor:
        """dQ/du [m, nu] (1/s) at inputs [s; e] [m, ni]: zero where the winch cannot reach."""
        return self.gradient(inputs).mul(inputs[:, MOVED].abs() < 1).div_(reach_m)

    def arrays(self) -> Arrays:
        """What the next iteration depends on, but for the transitions, which the run's tables hold."""
        tensors = {"learned": self._vector, "target": self._target} | self._moments._asdict()
        return {f"value_{name}": tensor.numpy().copy() for name, tensor in tensors.items()}

    def restore(self, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from `arrays()`; the transitions are yet to be added. KeyError when an entry is missing."""
        self._remembered.clear()
        self._vector.copy_(torch.from_numpy(arrays["value_learned"]))
        self._target.copy_(torch.from_numpy(arrays["value_target"]))
        names = supervised.Moments._fields
        self._moments = supervised.Moments(*(torch.from_numpy(arrays[f"value_{name}"]) for name in names))


def _portions(steps_n: int) -> list[int]:
    """Gradient steps in portions of PREPARED_N; the last may be smaller."""
    return [min(PREPARED_N, steps_n - first) for first in range(0, steps_n, PREPARED_N)]


def _moved(command: torch.Tensor, rest_lengths: torch.Tensor, reach_m: float) -> torch.Tensor:
    """e [m, nu] of commands [m, nu] (m) at rest lengths [m, nu] (m)."""
    return ((command - rest_lengths) / reach_m).clamp_(-1, 1)


def _actor(snapshot: PolicySnapshot) -> Callable[[torch.Tensor], torch.Tensor]:
    """Rest lengths [m, nu] (m) that a policy commands without noise where Q has the inputs [m, ni]."""
    _, layers = policy.parameters(snapshot)
    seen_n = layers[0][0].shape[1]

    def act(inputs: torch.Tensor) -> torch.Tensor:
        return policy.activations(layers, inputs[:, :seen_n])[-1].mul_(snapshot.scale_m).add_(snapshot.offset_m)

    return act
