"""An iteration done again is the one that was, and the slopes of the backward pass are those of its models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.algorithm.sub_trajectories import sub_trajectories
from t6gps.learner.bench import redone
from t6gps.learner.bench.redone import Redone
from t6gps.learner.learner import Learner
from t6gps.storage.records import PolicySnapshot

NOISE_STD_M, COST_WEIGHTS, HORIZON = 0.1, (0.8, 0.1), 10


@pytest.fixture
def done_again(make_learner: Callable[..., Learner], tables: list[pa.Table], untrained: PolicySnapshot) -> Redone:
    episodes = [(table, NOISE_STD_M) for table in tables]
    return redone.by_backward_pass(make_learner(), untrained, episodes, COST_WEIGHTS)


def test_an_iteration_done_again_promises_what_it_had_promised(
    make_learner: Callable[..., Learner], tables: list[pa.Table], iterate: Callable[..., None], done_again: Redone
) -> None:
    learner = make_learner()
    iterate(learner, tables)
    promised = done_again.improved.predicted_cost_change[done_again.rows.continues].mean(dtype=np.float64)
    assert learner.report().iteration["predicted_cost_change"] == promised


def test_the_slope_of_the_pass_is_that_of_the_cost_under_its_models(done_again: Redone) -> None:
    surrogate = done_again.surrogate
    slope = redone.slopes_of_pass(surrogate, HORIZON)
    models, of_row, nx = surrogate.series.models, surrogate.series.of_row, done_again.rows.state.shape[1]
    piece = sub_trajectories(done_again.rows.continues, HORIZON)[HORIZON][3] + np.arange(HORIZON)
    for begins in (0, 4, HORIZON - 1):
        steps, du = piece[begins:], 1e-3 * np.random.default_rng(begins).standard_normal(24)
        dx, changes = np.zeros(nx), []
        for row in steps:
            changes.append(du)
            dx = models.F[of_row[row]] @ np.concatenate([dx, du])
            du = models.P[of_row[min(row + 1, steps[-1])]] @ dx
        ahead = redone.promised(surrogate, steps[None], np.array(changes, dtype=np.float32)[None]).sum()
        back = redone.promised(surrogate, steps[None], -np.array(changes, dtype=np.float32)[None]).sum()
        assert (ahead - back) / 2 == pytest.approx(changes[0] @ slope[steps[0]], rel=1e-2, abs=1e-6)


def test_a_response_is_what_a_single_changed_action_does(done_again: Redone) -> None:
    surrogate, rows = done_again.surrogate, np.flatnonzero(done_again.rows.continues)[:5]
    change = np.full((5, 24), 0.01, dtype=np.float32)
    F, of_row, nx = surrogate.series.models.F, surrogate.series.of_row, done_again.rows.state.shape[1]
    for number, row in enumerate(rows):
        expected = F[of_row[row]] @ np.concatenate([np.zeros(nx), change[number]])
        assert redone.response(surrogate, rows, change)[number] == pytest.approx(expected, abs=1e-6)
