"""What improves the actions along sub-trajectories (Algorithm 2, lines 8 to 11), whatever it goes by."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm.model_series import ModelSeries
from t6gps.learner.algorithm.sub_trajectories import chunks
from t6gps.learner.rows import VELOCITY_N, Floats, Ints, Rows


class Change(NamedTuple):
    """What an improver wants along sub-trajectories of one length: k [b, T, nu] is added to the recorded actions (m).

    predicted_cost   change of the running cost after each step that the local models then expect [b, T] (m2/s2)
    """

    k: Floats
    predicted_cost: Floats


@dataclass(frozen=True)
class Improved:
    """Improved actions [n, nu] and the predicted change of the running cost that follows [n]; NaN without a sample."""

    action: Floats
    predicted_cost_change: Floats
    sub_trajectories: int


@dataclass(frozen=True)
class Surrogate:
    """Local models of the dynamics along the rows, and the cost."""

    rows: Rows
    series: ModelSeries
    target_speed_m_per_s: float
    vertical_weight: float

    def residual(self, steps: Ints) -> Floats:
        """r of the cost in the states after steps [b, T] at rows that continue [b, T, 3] (m/s)."""
        return self.residual_at(steps + 1)

    def residual_at(self, chosen: Ints) -> Floats:
        """r of the cost in the states of rows [...] as [..., 3] (m/s)."""
        state, target = self.rows.state[chosen, :VELOCITY_N], self.rows.target[chosen]
        residual: Floats = cost.residual(state, target, self.target_speed_m_per_s, self.vertical_weight)
        return residual

    def root(self) -> NDArray[np.floating]:
        """D of the cost [3, nx]."""
        return cost.root(self.rows.state.shape[1], self.vertical_weight)


class Improver(ABC):
    """Improves actions at the recorded states of one iteration."""

    @property
    def steps_n(self) -> int:
        """Steps of `prepare`."""
        return 0

    def prepare(self) -> Iterator[None]:
        """What comes before the first sub-trajectory; yields after each step."""
        return iter(())

    @abstractmethod
    def improve(self, steps: Ints) -> Change:
        """Improve the actions at rows [b, T] of b sub-trajectories; several calls may run at once."""


def improve(
    rows: Rows, improver: Improver, horizon_steps: int, command_range_m: tuple[float, float]
) -> Generator[tuple[int, int], None, Improved]:
    """Improve the actions along all sub-trajectories, on all cores; yields (done, total).

    The workers leave the cores idle while the learner works (but for a pipelined run), and chunks do not depend on each
    other, so the result is the same on any number of them.
    """
    action, predicted = np.full_like(rows.action, np.nan), np.full(len(rows.acts), np.nan, dtype=np.float32)
    parts = chunks(rows.continues, horizon_steps)
    sub_trajectories_n = sum(map(len, parts))
    done, total = 0, sub_trajectories_n + improver.steps_n
    for _ in improver.prepare():
        done += 1
        yield done, total
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        for steps, change in zip(parts, threads.map(improver.improve, parts), strict=True):
            action[steps], predicted[steps] = rows.action[steps] + change.k, change.predicted_cost
            done += len(steps)
            yield done, total
    np.clip(action, *command_range_m, out=action)
    return Improved(action, predicted, sub_trajectories_n)
