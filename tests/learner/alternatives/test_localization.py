"""Laws of the other localizations: every transition lies in one bin, and planted groups are found again."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.learner.algorithm.features import Rows
from t6gps.learner.algorithm.local_models import fit_class
from t6gps.learner.algorithm.modes import FitOptions, ModeSearch, fit_modes, moments
from t6gps.learner.alternatives import localization, mixtures
from t6gps.learner.settings import Localization

OPTIONS = FitOptions(modes=2, residual_threshold=0.35, prior_samples=50.0, ridge=1e-3)
ALTERNATIVES = [Localization.KIND, Localization.NONE, Localization.CLUSTERS]


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_every_transition_lies_in_exactly_one_bin(rows: Rows, alternative: Localization) -> None:
    jobs = localization.jobs(rows, alternative, OPTIONS, 0, 0)
    placed = np.concatenate([job.rows for job in jobs.values()])
    np.testing.assert_array_equal(np.sort(placed), np.flatnonzero(rows.continues))
    assert len({job.branch for job in jobs.values()}) == len(jobs)
    for job in jobs.values():
        np.testing.assert_array_equal(job.samples, rows.samples[job.rows])


def test_bins_by_kind_hold_one_kind_and_one_exit(rows: Rows) -> None:
    jobs = localization.jobs(rows, Localization.KIND, OPTIONS, 0, 0)
    found = [(set(rows.kind[job.rows].tolist()), set(rows.exit[job.rows].tolist())) for job in jobs.values()]
    assert all(len(kinds) == len(exits) == 1 for kinds, exits in found)
    assert len(localization.jobs(rows, Localization.NONE, OPTIONS, 0, 0)) == 1


def test_k_means_finds_planted_groups() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 5.0, 5.0]])
    planted = rng.integers(3, size=300)
    found = localization.k_means(centres[planted] + 0.3 * rng.standard_normal((300, 3)), 3, rng)
    assert len({(p, f) for p, f in zip(planted.tolist(), found.tolist(), strict=True)}) == 3


def test_a_mixture_finds_planted_components_and_survives_more_entries_than_samples() -> None:
    rng = np.random.default_rng(1)
    planted = rng.integers(2, size=400)
    a = 6.0 * planted[:, None] + rng.standard_normal((400, 5))
    found = mixtures.components(a, np.cov(a.T), 2, 10.0, 1e-3, rng)
    assert sorted(len(set(planted[own].tolist())) for own in found) == [1, 1]
    few = rng.standard_normal((6, 40))
    own = mixtures.components(few, np.eye(40), 4, 0.0, 1e-3, rng)
    assert sorted(np.concatenate(own).tolist()) == list(range(6))


@pytest.mark.parametrize("search", ModeSearch)
def test_both_searches_explain_two_planted_dynamics(search: ModeSearch) -> None:
    rng = np.random.default_rng(2)
    z, mode = rng.standard_normal((1200, 6)), rng.integers(2, size=1200)
    slopes = rng.standard_normal((2, 4, 6))
    following = np.einsum("nij,nj->ni", slopes[mode], z) + 8.0 * mode[:, None] + 0.01 * rng.standard_normal((1200, 4))
    samples = np.hstack([z, following])
    options = FitOptions(2, 0.35, 0.0, 1e-6, search)
    models, found, residual = fit_modes(samples, 4, moments(samples), options, rng)
    assert len(models) == 2
    assert len({(a, b) for a, b in zip(mode.tolist(), found.tolist(), strict=True)}) == 2
    assert np.median(residual) < 0.02


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_bins_are_fitted_as_classes_are(rows: Rows, alternative: Localization) -> None:
    job = localization.jobs(rows, alternative, OPTIONS, 0, 0)[0]
    fitted = fit_class(job)
    assert fitted.modes.tolist() == [len(fitted.models)]
    assert np.isfinite(fitted.residual).all()
