"""Laws of local models and of their association with rows."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from t6gps.learner.algorithm.local_models import ClassPlan, fit_class, job
from t6gps.learner.algorithm.local_models import plans as make_plans
from t6gps.learner.algorithm.model_series import patch
from t6gps.learner.algorithm.modes import FitOptions
from t6gps.learner.algorithm.regression import moments, pooled_moments
from t6gps.learner.algorithm.segments import Segments, group
from t6gps.learner.rows import NONE, Rows

OPTIONS = FitOptions(modes=4, residual_threshold=1.0, prior_samples=100.0, ridge=1e-3)


@pytest.fixture(scope="module")
def plans(rows: Rows, segments: Segments) -> dict[int, ClassPlan]:
    return make_plans(rows, segments, group(segments, 10), OPTIONS, run_seed=1, iteration=0)


def test_every_dynamics_sample_lies_in_exactly_one_bin(rows: Rows, plans: dict[int, ClassPlan]) -> None:
    taken = np.concatenate([plan.rows for plan in plans.values()])
    assert np.array_equal(np.sort(taken), np.flatnonzero(rows.continues))
    for plan in plans.values():
        assert plan.step.min() >= 0 and plan.step.max() < plan.steps


def test_crossings_are_alone_in_their_bins(rows: Rows, plans: dict[int, ClassPlan]) -> None:
    for plan in plans.values():
        crossing = rows.exit[plan.rows] != NONE
        assert np.array_equal(crossing, (plan.step == plan.steps - 1) & plan.crosses)


def test_the_models_of_a_row_lead_to_the_next_row(rows: Rows, plans: dict[int, ClassPlan]) -> None:
    fits = [fit_class(job(rows, plan)) for plan in plans.values()]
    series = patch(list(plans.values()), fits, len(rows.acts))
    assert np.array_equal(series.of_row != NONE, rows.continues)
    index = np.flatnonzero(rows.continues)
    F, f = series.models.F[series.of_row[index]], series.models.f[series.of_row[index]]
    z = np.hstack([rows.state, rows.action])[index]
    error = (F @ z[:, :, None])[:, :, 0] + f - rows.state[index + 1]
    spread = rows.state[index + 1].std(axis=0)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.5 * spread.max()
    assert np.nanmean(series.residual) < 0.4


def test_fits_give_identical_bytes_in_any_order_and_after_pickling(rows: Rows, plans: dict[int, ClassPlan]) -> None:
    forward = {number: fit_class(job(rows, plan)) for number, plan in plans.items()}
    for number in reversed(plans):
        again = fit_class(pickle.loads(pickle.dumps(job(rows, plans[number]))))
        assert pickle.dumps(again) == pickle.dumps(forward[number])


def test_seeds_of_all_jobs_differ_and_change_with_run_and_iteration(rows: Rows, segments: Segments) -> None:
    groups = group(segments, 10)
    seen = {
        (plan.run_seed, plan.branch)
        for run_seed, iteration in ((1, 0), (2, 0), (1, 1))
        for plan in make_plans(rows, segments, groups, OPTIONS, run_seed, iteration).values()
    }
    assert len(seen) == 3 * len(groups)


def test_moments_in_pieces_are_those_of_the_whole_and_equal_them_in_a_single_piece(rows: Rows) -> None:
    chosen = np.flatnonzero(rows.continues)
    whole = moments(rows.samples(chosen).astype(np.float64))
    for piece_rows in (len(chosen), 100):
        pooled = pooled_moments(rows, chosen, piece_rows)
        np.testing.assert_allclose(pooled.mean, whole.mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(pooled.covariance, whole.covariance, rtol=1e-10, atol=1e-12)
        equal = pooled.covariance.tobytes() == whole.covariance.tobytes()
        assert equal == (piece_rows == len(chosen)) and pooled.count == whole.count
