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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from t6gps.learner import cost, policy
from t6gps.learner.improvers.critic import Critic
from t6gps.learner.improvers.transitions import MOVED, OBSERVATION_N, Transitions, joined
from t6gps.learner.port import Arrays
from t6gps.learner.rows import VELOCITY_N, AnyArray, Floats, Ints, pieces
from t6gps.learner.settings import ActionValueSettings
from t6gps.storage import schema
from t6gps.storage.records import PolicySnapshot

PREPARED_N = 30
"""Gradient steps whose transitions are prepared at once."""
VELOCITY = slice(OBSERVATION_N, OBSERVATION_N + VELOCITY_N)
"""Where the velocity of the centre of mass is among [s; e]."""
STATE_N = VELOCITY_N + schema.SHAPE_N + (MOVED.stop - MOVED.start)
"""Entries of [velocity; nodes; rest lengths]."""


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
        self._critics = [Critic(settings, rng) for _ in range(settings.critics)]
        self._remembered: deque[Transitions] = deque(maxlen=settings.remembered_iterations)

    @property
    def steps_n(self) -> int:
        """Gradient steps that `learn` will take."""
        return self._settings.steps if self._critics[0].has_learned else self._settings.first_steps

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
        following = _mean([critic.target_values(after) for critic in self._critics])
        wanted = following.mul_(self._settings.discount).add_(reward)
        for critic in self._critics:
            critic.step(before, wanted)

    def improved(self, snapshot: PolicySnapshot, farther: Floats | None = None, share: float = 0.0) -> Floats:
        """u* [n, nu] (m) at the rows of the newest `improved_iterations`.

        farther   another estimate of dQ/de [n, nu] (m/s), which makes up `share` of the slope that is climbed
        """
        torch.set_num_threads(1)
        known, act, settings = self._newest(), _actor(snapshot), self._settings

        def climb(rows: Ints) -> torch.Tensor:
            inputs, rest_lengths = known.take(rows)
            start = act(inputs)
            command = start.clone()
            others = None if farther is None else torch.from_numpy(farther[rows]).mul_(share)
            for _ in range(settings.ascents):
                inputs[:, MOVED] = _moved(command, rest_lengths, known.reach_m)
                slope = self.gradient(inputs)
                if others is not None:
                    slope = slope.mul_(1 - share).add_(others)
                wanted = start + settings.step_weight * _of_commands(slope, inputs, known.reach_m)
                command += settings.ascent_rate * (wanted - command)
            return command

        return _every_row(climb, len(known.acts), MOVED.stop - MOVED.start)

    def state_slopes(self, snapshot: PolicySnapshot) -> Floats:
        """dV/dx [n, nx] at the same rows, x = [velocity; nodes; rest lengths] (m/s per m/s, m).

        V(x) = Q(s, e(u)) with the command u of a policy, held: rest lengths enter Q as a part of s, and through e.
        """
        torch.set_num_threads(1)
        known, act = self._newest(), _actor(snapshot)

        def slopes(rows: Ints) -> torch.Tensor:
            inputs, rest_lengths = known.take(rows)
            inputs[:, MOVED] = _moved(act(inputs), rest_lengths, known.reach_m)
            of = self._gradient(inputs)
            by_rest = of[:, schema.REST_LENGTHS] / schema.REST_LENGTH_SCALE_M
            by_rest -= _of_commands(of[:, MOVED], inputs, known.reach_m)
            return torch.hstack([of[:, VELOCITY], of[:, schema.NODES] / schema.NODE_SCALE_M, by_rest])

        return _every_row(slopes, len(known.acts), STATE_N)

    def _newest(self) -> Transitions:
        return joined(list(self._remembered)[-self._settings.improved_iterations :])

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
        """Q [m] of inputs [s; e] [m, ni] (m/s): the mean of all critics."""
        return _mean([critic.values(inputs) for critic in self._critics])[:, 0]

    def gradient(self, inputs: torch.Tensor) -> torch.Tensor:
        """dQ/de [m, nu] (m/s) at inputs [s; e] [m, ni]."""
        return self._gradient(inputs)[:, MOVED]

    def slope(self, inputs: torch.Tensor, reach_m: float) -> torch.Tensor:
        """dQ/du [m, nu] (1/s) at inputs [s; e] [m, ni]: zero where the winch cannot reach."""
        return _of_commands(self.gradient(inputs), inputs, reach_m)

    def _gradient(self, inputs: torch.Tensor) -> torch.Tensor:
        return _mean([critic.gradient(inputs) for critic in self._critics])

    def arrays(self) -> Arrays:
        """What the next iteration depends on, but for the transitions, which the run's tables hold."""
        critics = zip(_names(len(self._critics)), self._critics, strict=True)
        return {prefix + name: array for prefix, critic in critics for name, array in critic.arrays().items()}

    def restore(self, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from `arrays()`; the transitions are yet to be added. KeyError when an entry is missing."""
        self._remembered.clear()
        for prefix, critic in zip(_names(len(self._critics)), self._critics, strict=True):
            named = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            critic.restore(named)


def _names(critics_n: int) -> list[str]:
    """What the names of the arrays of each critic begin with."""
    return ["value_", *(f"value{number}_" for number in range(2, critics_n + 1))]


def _mean(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """The mean of equal shapes; a single one as it is."""
    return parts[0] if len(parts) == 1 else torch.stack(list(parts)).mean(dim=0)


def _every_row(function: Callable[[Ints], torch.Tensor], n: int, width: int) -> Floats:
    """What a function finds at rows [m, width], for all n rows, on all cores."""
    parts = np.split(np.arange(n), range(policy.ROWS, n, policy.ROWS))
    found = np.empty((n, width), dtype=np.float32)
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        for rows, values in zip(parts, threads.map(function, parts), strict=True):
            found[rows] = values.numpy()
    return found


def _of_commands(slope: torch.Tensor, inputs: torch.Tensor, reach_m: float) -> torch.Tensor:
    """d/du [m, nu] of what has the slopes d/de [m, nu] at inputs [s; e]: zero where the winch cannot reach."""
    return slope * (inputs[:, MOVED].abs() < 1) / reach_m


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
