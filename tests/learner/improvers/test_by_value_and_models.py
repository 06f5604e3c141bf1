"""The backward pass that ends in a value: slopes of the return of linear models, by differences and in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm.model_series import ModelSeries
from t6gps.learner.algorithm.regression import Models
from t6gps.learner.improvers.by_value_and_models import slopes
from t6gps.learner.improvers.improver import Surrogate
from t6gps.learner.rows import NONE, Rows

NX, NU, N, MODELS_N = 6, 2, 30, 4
SPEED, WEIGHT, DISCOUNT = 2.0, 0.1, 0.9
BREAK = 20
"""A row after which the trajectory does not continue; nor does it after the last."""


@pytest.fixture(scope="module")
def surrogate() -> Surrogate:
    rng = np.random.default_rng(0)
    continues = ~np.isin(np.arange(N), [BREAK, N - 1])
    angle = rng.uniform(-np.pi, np.pi, N)
    nothing, flags = np.zeros(N, dtype=np.int64), np.zeros(N, dtype=bool)
    rows = Rows(
        state=rng.normal(0, 0.5, (N, NX)).astype(np.float32),
        action=rng.uniform(-1, 1, (N, NU)).astype(np.float32),
        action_mean=np.zeros((N, NU), dtype=np.float32),
        target=np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32),
        observation=np.zeros((N, 1), dtype=np.float32),
        noise_std_m=np.zeros(N, dtype=np.float32),
        kind=nothing,
        entry=nothing,
        exit=nothing,
        starts=flags,
        acts=continues,
        continues=continues,
    )
    models = Models(
        F=rng.normal(0, 0.4, (MODELS_N, NX, NX + NU)),
        f=np.zeros((MODELS_N, NX)),
        P=rng.normal(0, 0.3, (MODELS_N, NU, NX)),
        p=np.zeros((MODELS_N, NU)),
        variance=np.ones((MODELS_N, NU)),
    )
    of_row = np.where(continues, rng.integers(MODELS_N, size=N), NONE)
    return Surrogate(rows, ModelSeries(models, of_row, np.zeros(N)), SPEED, WEIGHT)


def rewarded(surrogate: Surrogate, row: int, dx: NDArray[np.float64]) -> float:
    """-cost / (2 v*) in the state of a row moved by dx."""
    state = surrogate.rows.state[row].astype(np.float64) + dx
    return float(cost.running_cost(state, surrogate.rows.target[row], SPEED, WEIGHT) / (-2 * SPEED))


def returned(surrogate: Surrogate, ends: NDArray[np.float32], row: int, length: int, de: NDArray[np.float64]) -> float:
    """What follows a changed action at a row: rewards of `length` steps at most, then the value, all by the models."""
    models, of_row = surrogate.series.models, surrogate.series.of_row
    dx, total, discount, at = np.zeros(NX), 0.0, 1.0, row
    for step in range(length):
        change = de if step == 0 else models.P[of_row[at]] @ dx
        dx = models.F[of_row[at]] @ np.concatenate([dx, change])
        at += 1
        total += discount * rewarded(surrogate, at, dx)
        discount *= DISCOUNT
        if of_row[at] == NONE:
            break
    return total + discount * float(ends[at] @ dx)


@pytest.mark.parametrize("horizon_steps", [1, 2, 3, 7])
def test_the_slope_is_that_of_the_mean_return_over_all_lengths(surrogate: Surrogate, horizon_steps: int) -> None:
    ends = np.random.default_rng(1).normal(0, 1, (N, NX)).astype(np.float32)
    found, step = slopes(surrogate, ends, DISCOUNT, horizon_steps), 1e-4
    for row in np.flatnonzero(surrogate.rows.continues).tolist():
        for winch in range(NU):
            de = np.zeros(NU)
            de[winch] = step
            differences = [
                (returned(surrogate, ends, row, n, de) - returned(surrogate, ends, row, n, -de)) / (2 * step)
                for n in range(1, horizon_steps + 1)
            ]
            assert found[row, winch] == pytest.approx(np.mean(differences), rel=1e-3, abs=1e-4)
    assert not found[~surrogate.rows.continues].any()


def test_models_that_do_not_respond_have_no_slope(surrogate: Surrogate) -> None:
    F = surrogate.series.models.F.copy()
    F[:, :, NX:] = 0
    dead = replace(surrogate, series=replace(surrogate.series, models=replace(surrogate.series.models, F=F)))
    assert not slopes(dead, np.ones((N, NX), dtype=np.float32), DISCOUNT, 3).any()
