"""Improved actions from a learned action value (beyond the paper): it sees farther than local models reach.

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
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from t6gps.learner import cost, policy
from t6gps.learner.algorithm import supervised
from t6gps.learner.algorithm.features import acting_rows
from t6gps.storage import schema
from t6gps.storage.records import PolicySnapshot

Floats = NDArray[np.float32]

INPUTS = ("observation", "com_velocity", "node_velocities", "action")
COLUMNS = (*INPUTS, "rest_lengths", "target_direction", "frame_yaw_rad", "element")
"""Columns of `frames` that the value is learned from, and of these what its network gets."""
OBSERVATION_N, *_, ACTION_N = LENGTHS = [schema.vector_length(schema.FRAMES.field(name)) or 0 for name in INPUTS]
INPUTS_N = sum(LENGTHS)
COM_VELOCITY, MOVED = slice(OBSERVATION_N, OBSERVATION_N + LENGTHS[1]), slice(INPUTS_N - ACTION_N, INPUTS_N)
"""Where the velocity of the centre of mass is among them, and e."""
REMEMBERED_N = 3
"""Iterations whose transitions are learned from; six are no better."""
DISCOUNT = 0.95
"""Per control step: a horizon of two seconds."""
HIDDEN = (128, 128)
BATCH, STEPS, FIRST_STEPS, LEARNING_RATE = 256, 600, 1800, 1e-3
"""Gradient steps per iteration, and of the first one, which finds a network that knows nothing."""
WEIGHT_DECAY = 0.01
PREPARED_N = 30
"""Gradient steps whose transitions are prepared at once."""
TARGET_RATE = 0.005
"""The network in the temporal-difference target follows the learned one by this share per step."""
OWN_SHARE = 0.5
"""Share of transitions that are learned from with the direction of their waypoint."""
STEP_WEIGHT = 0.3
"""w (m2 s/m): larger ones trust the value farther from the policy."""
ASCENTS, ASCENT_RATE = 4, 0.5


class Transitions(NamedTuple):
    """Rows of the episodes of one iteration [n], in order.

    inputs         what Q sees, [s; e] [n, ni]; e is zero in the last row of an episode
    rest_lengths   [n, nu] (m)
    turn, side     a horizontal direction of the world has the angle turn + side * angle in the frame of a row [n]
    heading        of the waypoint in the world [n] (rad)
    acts           the row has an action, and the row after it is what followed [n]
    """

    inputs: Floats
    rest_lengths: Floats
    turn: Floats
    side: Floats
    heading: Floats
    acts: NDArray[np.bool_]

    def direction(self, rows: NDArray[np.int64], heading: Floats) -> Floats:
        """A heading [m] in the frames of rows [m, 2]."""
        angle = self.turn[rows] + self.side[rows] * heading
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def towards(self, rows: NDArray[np.int64], direction: Floats) -> torch.Tensor:
        """Inputs in rows [m, ni] if the waypoint lies in a direction [m, 2]."""
        inputs = self.inputs[rows]
        inputs[:, schema.TARGET] = direction
        return torch.from_numpy(inputs)


def read(episodes: Mapping[int, pa.Table], mirrored: NDArray[np.bool_], reach_m: float) -> Transitions:
    """Transitions of the `frames` tables in `episodes`; DataError as for `features.read_rows`.

    `mirrored` [elements] says which symmetry elements mirror the world; `reach_m` is as in `ActionValue`.
    """
    tables, acts, _ = acting_rows(episodes)
    table = pa.concat_tables([table.select(COLUMNS) for table in tables])
    *numbers, element = (schema.array(table, name) for name in COLUMNS)
    *state, action, rest, target, turn = (np.asarray(part, dtype=np.float32) for part in numbers)
    moved = np.zeros_like(rest)
    moved[acts] = np.clip((action - rest[acts]) / reach_m, -1, 1)
    side = np.where(mirrored[element], np.float32(-1), np.float32(1))
    heading = side * (np.arctan2(target[:, 1], target[:, 0]) - turn)
    return Transitions(np.hstack([*state, moved]), rest, turn, side, heading, acts)


class ActionValue:
    """Q of the newest policy, and the transitions that it is learned from.

    reach_m                                 farthest that a winch comes in a control step
    target_speed_m_per_s, vertical_weight   v* of the cost and weight of the vertical velocity in it
    """

    def __init__(
        self, reach_m: float, target_speed_m_per_s: float, vertical_weight: float, rng: np.random.Generator
    ) -> None:
        self._target_speed_m_per_s, self._vertical_weight = target_speed_m_per_s, vertical_weight
        first = policy.initial(INPUTS_N, 1, HIDDEN, rng, offset_m=0.0, scale_m=1.0)
        self._reach_m = reach_m
        self._vector, self._layers = policy.parameters(first)
        self._target, self._target_layers = policy.parameters(first)
        self._moments = supervised.no_moments(self._vector)
        self._remembered: deque[Transitions] = deque(maxlen=REMEMBERED_N)

    @property
    def steps_n(self) -> int:
        """Gradient steps that `learn` will take."""
        return STEPS if self._moments.step else FIRST_STEPS

    def add(self, transitions: Transitions) -> None:
        """Take the transitions of one iteration; those of the oldest go."""
        self._remembered.append(transitions)

    def learn(self, snapshot: PolicySnapshot, rng: np.random.Generator) -> Iterator[None]:
        """Take `steps_n` gradient steps towards the value of a policy; yields after each."""
        torch.set_num_threads(1)
        known = Transitions(*map(np.concatenate, zip(*self._remembered, strict=True)))
        index = np.flatnonzero(known.acts)
        mean = self._reward(known, index + 1, known.direction(index + 1, known.heading[index])).mean()
        act = _actor(snapshot)
        for _ in range(self.steps_n // PREPARED_N):
            rows = rng.choice(index, PREPARED_N * BATCH)
            anywhere = rng.uniform(-np.pi, np.pi, len(rows)).astype(np.float32)
            heading = np.where(rng.random(len(rows)) < OWN_SHARE, known.heading[rows], anywhere)
            direction = known.direction(rows + 1, heading)
            before = known.towards(rows, known.direction(rows, heading))
            after = known.towards(rows + 1, direction)
            after[:, MOVED] = self._moved(known, rows + 1, act(after))
            reward = torch.from_numpy(self._reward(known, rows + 1, direction) - mean)
            prepared = (part.view(PREPARED_N, BATCH, -1) for part in (before, after, reward))
            for batch in zip(*prepared, strict=True):
                self._step(*batch)
                yield

    def _step(self, before: torch.Tensor, after: torch.Tensor, reward: torch.Tensor) -> None:
        """One gradient step on transitions: [s; e] before and after [m, ni], and the reward [m, 1]."""
        wanted = policy.activations(self._target_layers, after)[-1].mul_(DISCOUNT).add_(reward)
        change = supervised.gradient(self._layers, before, wanted, BATCH)
        supervised.descend(self._vector, change, self._moments, LEARNING_RATE, WEIGHT_DECAY)
        self._target.lerp_(self._vector, TARGET_RATE)

    def improved(self, snapshot: PolicySnapshot) -> Floats:
        """u* [n, nu] (m) at the rows of the newest transitions."""
        torch.set_num_threads(1)
        newest, act = self._remembered[-1], _actor(snapshot)

        def climb(rows: NDArray[np.int64]) -> torch.Tensor:
            inputs = torch.from_numpy(newest.inputs[rows])
            own = act(inputs)
            command = own.clone()
            for _ in range(ASCENTS):
                inputs[:, MOVED] = self._moved(newest, rows, command)
                command += ASCENT_RATE * (own + STEP_WEIGHT * self._slope(inputs) - command)
            return command

        n = len(newest.acts)
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            climbed = threads.map(climb, np.split(np.arange(n), range(policy.ROWS, n, policy.ROWS)))
            found: Floats = torch.cat(list(climbed)).numpy()
        return found

    def _reward(self, known: Transitions, rows: NDArray[np.int64], direction: Floats) -> Floats:
        """-cost / (2 v*) in rows [m] (m/s)."""
        speed = self._target_speed_m_per_s
        spent = cost.running_cost(known.inputs[rows, COM_VELOCITY], direction, speed, self._vertical_weight)
        return (spent / (-2 * speed)).astype(np.float32)

    def _moved(self, known: Transitions, rows: NDArray[np.int64], command: torch.Tensor) -> torch.Tensor:
        """e [m, nu] of commands [m, nu] (m) in rows [m]."""
        return ((command - torch.from_numpy(known.rest_lengths[rows])) / self._reach_m).clamp_(-1, 1)

    def _slope(self, inputs: torch.Tensor) -> torch.Tensor:
        """dQ/du [m, nu] (1/s): zero where the winch cannot reach."""
        values = policy.activations(self._layers, inputs)
        back = self._layers[-1][0].expand(len(inputs), -1)
        for number in reversed(range(len(HIDDEN))):
            back = torch.ops.aten.tanh_backward(back, values[number + 1]) @ self._layers[number][0]
        return back[:, MOVED].mul(inputs[:, MOVED].abs() < 1).div_(self._reach_m)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What the next iteration depends on, but for the transitions, which the run's tables hold."""
        found = {"learned": self._vector, "target": self._target} | self._moments._asdict()
        return {f"value_{name}": tensor.numpy().copy() for name, tensor in found.items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue from `arrays()`; the transitions are yet to be added. KeyError when an entry is missing."""
        self._remembered.clear()
        self._vector.copy_(torch.from_numpy(arrays["value_learned"]))
        self._target.copy_(torch.from_numpy(arrays["value_target"]))
        names = supervised.Moments._fields
        self._moments = supervised.Moments(*(torch.from_numpy(arrays[f"value_{name}"]) for name in names))


def _actor(snapshot: PolicySnapshot) -> Callable[[torch.Tensor], torch.Tensor]:
    """Rest lengths [m, nu] (m) that a policy commands without noise where Q has the inputs [m, ni]."""
    _, layers = policy.parameters(snapshot)
    seen_n = layers[0][0].shape[1]

    def act(inputs: torch.Tensor) -> torch.Tensor:
        return policy.activations(layers, inputs[:, :seen_n])[-1].mul_(snapshot.scale_m).add_(snapshot.offset_m)

    return act
