"""Laws of the other localizations: every transition lies in one bin, and planted groups are found again."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.learner.algorithm.features import Rows
from t6gps.learner.algorithm.local_models import fit_class, job
from t6gps.learner.algorithm.modes import FitOptions
from t6gps.learner.alternatives import localization
from t6gps.learner.settings import Localization

OPTIONS = FitOptions(modes=2, residual_threshold=0.35, prior_samples=50.0, ridge=1e-3)
ALTERNATIVES = [Localization.KIND, Localization.NONE, Localization.CLUSTERS]


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_every_transition_lies_in_exactly_one_bin(rows: Rows, alternative: Localization) -> None:
    plans = localization.plans(rows, alternative, OPTIONS, 0, 0)
    placed = np.concatenate([plan.rows for plan in plans.values()])
    np.testing.assert_array_equal(np.sort(placed), np.flatnonzero(rows.continues))
    assert len({plan.branch for plan in plans.values()}) == len(plans)


def test_bins_by_kind_hold_one_kind_and_one_exit(rows: Rows) -> None:
    plans = localization.plans(rows, Localization.KIND, OPTIONS, 0, 0)
    bins = [(set(rows.kind[plan.rows].tolist()), set(rows.exit[plan.rows].tolist())) for plan in plans.values()]
    assert all(len(kinds) == len(exits) == 1 for kinds, exits in bins)
    assert len(localization.plans(rows, Localization.NONE, OPTIONS, 0, 0)) == 1


def test_k_means_finds_planted_groups() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 5.0, 5.0]])
    planted = rng.integers(3, size=300)
    clusters = localization.k_means(centres[planted] + 0.3 * rng.standard_normal((300, 3)), 3, rng)
    assert len({(p, f) for p, f in zip(planted.tolist(), clusters.tolist(), strict=True)}) == 3


def test_clusters_are_a_function_of_states_and_generator(rows: Rows) -> None:
    first, second, other = (localization.k_means(rows.state, 8, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert np.array_equal(first, second) and not np.array_equal(first, other)
    assert len(np.unique(localization.k_means(rows.state[:3], 8, np.random.default_rng(0)))) == 3


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_bins_are_fitted_as_classes_are(rows: Rows, alternative: Localization) -> None:
    plan = localization.plans(rows, alternative, OPTIONS, 0, 0)[0]
    fitted = fit_class(job(rows, plan))
    assert fitted.modes.tolist() == [len(fitted.models)]
    assert np.isfinite(fitted.residual).all()
