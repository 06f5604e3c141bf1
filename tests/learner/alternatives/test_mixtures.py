"""Laws of the Gaussian mixture: planted components and planted dynamics are found again."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.learner.algorithm.modes import FitOptions, Search, fit_modes, ransac
from t6gps.learner.algorithm.regression import moments
from t6gps.learner.alternatives import mixtures


def test_a_mixture_finds_planted_components_and_survives_more_entries_than_samples() -> None:
    rng = np.random.default_rng(1)
    planted = rng.integers(2, size=400)
    a = 6.0 * planted[:, None] + rng.standard_normal((400, 5))
    likeliest = mixtures.components(a, np.cov(a.T), 2, 10.0, 1e-3, rng)
    assert sorted(len(set(planted[members].tolist())) for members in likeliest) == [1, 1]
    few = rng.standard_normal((6, 40))
    likeliest = mixtures.components(few, np.eye(40), 4, 0.0, 1e-3, rng)
    assert sorted(np.concatenate(likeliest).tolist()) == list(range(6))


@pytest.mark.parametrize("search", [ransac, mixtures.gaussian])
def test_both_searches_explain_two_planted_dynamics(search: Search) -> None:
    rng = np.random.default_rng(2)
    z, mode = rng.standard_normal((1200, 6)), rng.integers(2, size=1200)
    slopes = rng.standard_normal((2, 4, 6))
    following = np.einsum("nij,nj->ni", slopes[mode], z) + 8.0 * mode[:, None] + 0.01 * rng.standard_normal((1200, 4))
    samples = np.hstack([z, following])
    options = FitOptions(2, 0.35, 0.0, 1e-6, search)
    models, assigned, residual = fit_modes(samples, 4, moments(samples), options, rng)
    assert len(models) == 2
    assert len({(a, b) for a, b in zip(mode.tolist(), assigned.tolist(), strict=True)}) == 2
    assert np.median(residual) < 0.02


def test_a_single_sample_is_a_component() -> None:
    likeliest = mixtures.components(np.zeros((1, 3)), np.eye(3), 4, 10.0, 1e-3, np.random.default_rng(0))
    assert [members.tolist() for members in likeliest] == [[0]]
