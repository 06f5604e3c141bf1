"""An iteration of a stored run done again up to its S-step, and what its models and its action value hold of actions.

Both improvers work on the same rows, whichever of them led the iteration. Slopes are of the cost, by the action:

    backward pass    dJ/du[t] = Fu[t]' (D'r[t] + lambda[t+1]),    lambda[t] = (Fx + Fu P)[t]' (D'r[t] + lambda[t+1])

to the end of the sub-trajectory, where lambda is zero; r[t] is the residual of the cost after step t, as in
`backward_pass`. Action value: dJ/de = -2 v* dQ/de, since Q adds up -cost / (2 v*).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner.algorithm.backward_pass import predicted_change
from t6gps.learner.algorithm.sub_trajectories import chunks
from t6gps.learner.checkpoint import Carried
from t6gps.learner.improvers import improver
from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.improvers.by_action_value import ByActionValue
from t6gps.learner.improvers.improver import Improved, Surrogate
from t6gps.learner.improvers.transitions import MOVED, Transitions
from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.report import Segmented
from t6gps.learner.rows import Floats, Ints, Rows
from t6gps.learner.settings import LearnerSettings
from t6gps.learner.streams import Stream, branch, generator
from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot

Frames = Iterable[tuple[pa.Table, float]]
"""Frames of episodes in ascending order of their ids, each with the exploration noise of its plan (m)."""


@dataclass(frozen=True)
class Redone:
    """What the phases before the S-step have found, with the improved actions of the backward pass."""

    segmented: Segmented
    surrogate: Surrogate
    improved: Improved

    @property
    def rows(self) -> Rows:
        """Rows of all episodes, one under another."""
        return self.segmented.rows


def by_backward_pass(
    learner: Learner, snapshot: PolicySnapshot, episodes: Frames, cost_weights: tuple[float, float]
) -> Redone:
    """The iteration of a policy by a learner whose settings have no action value; `cost_weights` are v* and w."""
    learner.restore(*Carried(snapshot, 0, keeps_earlier=False).pack(None))
    for frames, noise_std_m in episodes:
        learner.add(frames, noise_std_m)
    for phase in PHASES[:-1]:
        _exhaust(getattr(learner, phase.name)())
    segmented, fitted, improved = learner.done.segmented, learner.done.fitted, learner.done.improved
    if segmented is None or fitted is None or improved is None:
        raise DataError("the learner's phases have left nothing behind; this is a fault of the program")
    return Redone(segmented, Surrogate(segmented.rows, fitted.series, *cost_weights), improved)


@dataclass(frozen=True)
class Valued:
    """The action value of an iteration, what it is asked about, and the actions that it improves."""

    value: ActionValue
    transitions: Transitions
    improved: Improved


def by_action_value(
    redone: Redone,
    settings: LearnerSettings,
    run_seed: int,
    iteration: int,
    command_range_m: tuple[float, float],
    policy_of: Callable[[int], PolicySnapshot],
    transitions_of: Callable[[int], Transitions],
) -> Valued:
    """The same iteration by the action value alone of a run that has one, learned as the run did in its first round.

    Before the iteration `value_from` it is what the run would have learned, had it begun in the iteration asked for.
    """
    surrogate = redone.surrogate
    of_value = settings.action_value.model_copy(update={"improved_iterations": 1})

    def rng(at: int) -> np.random.Generator:
        return generator(run_seed, branch(at, Stream.ACTION_VALUE))

    value = ActionValue(of_value, surrogate.target_speed_m_per_s, surrogate.vertical_weight, rng(0))
    first = min(settings.value_from, iteration)
    for earlier in range(max(first - of_value.remembered_iterations + 1, 0), first):
        value.add(transitions_of(earlier))
    for at in range(first, iteration):
        value.add(transitions_of(at))
        _exhaust(value.learn(policy_of(at), rng(at)))
    newest = transitions_of(iteration)
    value.add(newest)
    alone = settings.model_copy(update={"models_share": 0.0, "action_value": of_value})
    leading = ByActionValue(surrogate, value, policy_of(iteration), rng(iteration), command_range_m, alone)
    improving = improver.improve(redone.rows, leading, settings.horizon_steps, command_range_m)
    return Valued(value, newest, _result(improving))


def promised(surrogate: Surrogate, steps: Ints, change: Floats) -> Floats:
    """Change of the running cost after each step [b, T] that the models promise (m2/s2).

    steps    rows of pieces of trajectories [b, T], all of which continue
    change   of the actions, whatever state they meet [b, T, nu] (m)
    """
    F, of_row = surrogate.series.models.F.astype(np.float32), surrogate.series.of_row
    return predicted_change(F, of_row[steps], surrogate.residual(steps), surrogate.root(), change)


def response(surrogate: Surrogate, rows: Ints, change: Floats) -> Floats:
    """Change Fu du of the next reduced state [b, nx] that the models expect of changed actions [b, nu] at rows [b]."""
    Fu = surrogate.series.models.F[surrogate.series.of_row[rows], :, surrogate.rows.state.shape[1] :]
    return np.einsum("bxu,bu->bx", Fu, change).astype(np.float32)


def slopes_of_pass(surrogate: Surrogate, horizon_steps: int) -> Floats:
    """dJ/du of the backward pass at all rows [n, nu] (m/s2); NaN where a row does not continue."""
    models, of_row = surrogate.series.models, surrogate.series.of_row
    slope, nx = np.full_like(surrogate.rows.action, np.nan), surrogate.rows.state.shape[1]
    Fx, Fu = models.F[:, :, :nx], models.F[:, :, nx:]
    closed = Fx + Fu @ models.P
    for steps in chunks(surrogate.rows.continues, horizon_steps):
        here = surrogate.residual(steps) @ surrogate.root()
        ahead: NDArray[np.floating] = np.zeros((len(steps), nx))
        for step in reversed(range(steps.shape[1])):
            model, toward = of_row[steps[:, step]], here[:, step] + ahead
            slope[steps[:, step]] = np.einsum("bxu,bx->bu", Fu[model], toward)
            ahead = np.einsum("bxy,bx->by", closed[model], toward)
    return slope


def slopes_of_value(valued: Valued, rows: Ints, moved: Floats, target_speed_m_per_s: float) -> Floats:
    """dJ/de of the action value [m, nu] (m2/s2) at effective actions e [m, nu] in rows [m]."""
    inputs, _ = valued.transitions.take(rows)
    inputs[:, MOVED] = inputs.new_tensor(moved)
    gradient: Floats = valued.value.gradient(inputs).numpy()
    return gradient * (-2 * target_speed_m_per_s)


def _exhaust(steps: Iterator[object]) -> None:
    deque(steps, maxlen=0)


def _result(improving: Iterator[tuple[int, int]]) -> Improved:
    """What a generator returns at its end."""
    while True:
        try:
            next(improving)
        except StopIteration as end:
            improved: Improved = end.value
            return improved
