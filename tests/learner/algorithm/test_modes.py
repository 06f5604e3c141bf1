"""Laws of the multi-modal fit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from t6gps.learner.algorithm.modes import FitOptions, fit_modes
from t6gps.learner.algorithm.regression import Models, Moments, moments
from t6gps.learner.bench.references import sklearn_modes

NX, NU = 6, 4
ALONE = FitOptions(modes=4, residual_threshold=1.0, prior_samples=0.0, ridge=1e-9)
Array = NDArray[np.float64]


def plant(n: int, F: Array, rng: np.random.Generator, noise: float = 1e-6, offset: float = 0.3) -> Array:
    """Samples of x' = F [x; u] + offset and u = P x + 0.5 noise."""
    x = rng.normal(2, 1, (n, NX)) * np.array([1, 2, 0.5, 1, 1, 3])
    u = x @ gain().T + 0.5 * rng.normal(size=(n, NU))
    z = np.hstack([x, u])
    return np.hstack([z, z @ F.T + offset + noise * rng.normal(size=(n, NX))])


def gain() -> Array:
    return np.random.default_rng(9).normal(0, 0.2, (NU, NX))


def system(seed: int) -> Array:
    return np.random.default_rng(seed).normal(0, 0.5, (NX, NX + NU))


def fit(samples: Array, options: FitOptions = ALONE, prior: Moments | None = None) -> tuple[Models, Array, Array]:
    return fit_modes(samples, NX, prior or moments(samples), options, np.random.default_rng(0))


def test_a_planted_linear_system_and_policy_are_recovered() -> None:
    samples = plant(3000, system(1), np.random.default_rng(2))
    models, mode, residual = fit(samples)
    assert len(models) == 1 and (mode == 0).all()
    np.testing.assert_allclose(models.F[0], system(1), atol=1e-3)
    np.testing.assert_allclose(models.P[0], gain(), atol=0.06)
    np.testing.assert_allclose(models.variance[0], 0.25, rtol=0.1)
    np.testing.assert_allclose(samples[:, : NX + NU] @ models.F[0].T + models.f[0], samples[:, NX + NU :], atol=1e-2)
    assert residual.max() < 1e-2


def test_the_recovered_policy_goes_through_the_mean() -> None:
    samples = plant(500, system(1), np.random.default_rng(2))
    models, _, _ = fit(samples)
    mean = samples.mean(axis=0)
    np.testing.assert_allclose(models.P[0] @ mean[:NX] + models.p[0], mean[NX : NX + NU], atol=1e-9)


def test_an_agreeing_prior_recovers_the_system_from_fewer_samples_than_regressors() -> None:
    pool = plant(3000, system(1), np.random.default_rng(2))
    few = plant(6, system(1), np.random.default_rng(3), offset=1.7)
    options = FitOptions(modes=1, residual_threshold=10.0, prior_samples=500.0, ridge=1e-9)
    models, _, _ = fit(few, options, moments(pool))
    np.testing.assert_allclose(models.F[0], system(1), atol=1e-3)
    np.testing.assert_allclose(few[:, : NX + NU] @ models.F[0].T + models.f[0], few[:, NX + NU :], atol=0.05)


def test_the_prior_moves_slopes_from_the_samples_own_to_the_pooled_ones() -> None:
    pool, planted = moments(plant(3000, system(1), np.random.default_rng(2))), system(1) + 0.2
    samples = plant(300, planted, np.random.default_rng(3))
    distances = []
    for weight in (0.0, 30.0, 300.0, 3000.0, 1e6):
        options = FitOptions(modes=1, residual_threshold=10.0, prior_samples=weight, ridge=1e-9)
        distances.append(np.linalg.norm(fit(samples, options, pool)[0].F[0] - planted))
    assert distances[0] < 1e-3 and distances[-1] == pytest.approx(np.linalg.norm(system(1) - planted), rel=0.01)
    assert distances == sorted(distances)


def test_the_prior_moves_the_policy_covariance_from_the_samples_own_to_the_pooled_one() -> None:
    pool, samples = (plant(n, system(1), np.random.default_rng(n)) for n in (3000, 300))
    samples[:, NX : NX + NU] *= 3.0
    variances = []
    for weight in (0.0, 1e6):
        options = FitOptions(modes=1, residual_threshold=10.0, prior_samples=weight, ridge=1e-9)
        variances.append(float(fit(samples, options, moments(pool))[0].variance.mean()))
    assert variances[0] == pytest.approx(9 * 0.25, rel=0.1) and variances[1] == pytest.approx(0.25, rel=0.1)


@pytest.mark.parametrize("threshold", [0.2, 1.0])
@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_two_planted_modes_are_separated_and_each_recovered(threshold: float, offset: float) -> None:
    which = np.repeat([0, 1], [350, 250])
    options = FitOptions(modes=2, residual_threshold=threshold, prior_samples=0.0, ridge=1e-6)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        parts = [plant(350, system(1), rng, 0.01, offset=0.0), plant(250, system(6), rng, 0.01, offset=offset)]
        samples, order = np.vstack(parts), rng.permutation(600)
        models, mode, residual = fit_modes(samples[order], NX, moments(samples), options, rng)
        assert len(models) == 2 and residual.mean() < 0.05
        agreement = (mode == which[order]).mean()
        assert max(agreement, 1 - agreement) > 0.99
        first = int(agreement < 0.5)
        np.testing.assert_allclose(models.F[first], system(1), atol=0.01)
        np.testing.assert_allclose(models.F[1 - first], system(6), atol=0.01)


def test_more_modes_never_raise_the_residual_and_one_mode_is_the_limit_asked_for() -> None:
    rng = np.random.default_rng(4)
    samples = np.vstack([plant(300, system(seed), rng, 0.3) for seed in range(3)])
    results = {}
    for modes in (1, 4):
        models, _, residual = fit(samples, FitOptions(modes, 0.5, 50.0, 1e-3))
        results[modes] = (len(models), float(residual.mean()))
    assert results[1][0] == 1 and results[4][0] > 1
    assert results[4][1] < results[1][1]


def test_each_sample_has_the_mode_with_the_least_residual() -> None:
    rng = np.random.default_rng(4)
    samples = np.vstack([plant(300, system(seed), rng, 0.3) for seed in range(2)])
    models, mode, _ = fit(samples, FitOptions(4, 0.5, 50.0, 1e-3))
    z, target = samples[:, : NX + NU], samples[:, NX + NU :]
    share = np.array([1 / 6] * 3 + [1 / 6] * 3) / target.var(axis=0)
    errors = np.stack(
        [(share * (z @ F.T + f - target) ** 2).sum(axis=1) for F, f in zip(models.F, models.f, strict=True)]
    )
    assert np.array_equal(errors.argmin(axis=0), mode)


def test_dependent_columns_do_no_harm() -> None:
    """Node positions about the centre of mass sum to zero, and a constant column has no variance."""
    samples = plant(2000, system(1), np.random.default_rng(2), noise=0.01)
    samples[:, 5] = -samples[:, 3:5].sum(axis=1)
    samples[:, NX + NU + 5] = -samples[:, NX + NU + 3 : NX + NU + 5].sum(axis=1)
    samples[:, 2] = 0.7
    models, _, residual = fit(samples, FitOptions(1, 1.0, 100.0, 1e-3))
    assert np.isfinite(models.F).all() and np.abs(models.F).max() < 20
    assert residual.mean() < 0.5
    np.testing.assert_allclose(models.F[0, 3:6].sum(axis=0), 0, atol=1e-8)
    np.testing.assert_allclose(models.F[0, :, 2], 0, atol=1e-8)


def test_units_do_not_matter() -> None:
    samples = plant(800, system(1), np.random.default_rng(2), noise=0.5)
    scale = np.concatenate([scale_x := 10.0 ** np.arange(-2, 4), [3.0] * NU, scale_x])
    options = FitOptions(3, 0.4, 200.0, 1e-3)
    plain, mode, residual = fit(samples, options)
    scaled, scaled_mode, scaled_residual = fit(samples * scale, options)
    assert np.array_equal(mode, scaled_mode)
    np.testing.assert_allclose(residual, scaled_residual, atol=1e-8)
    np.testing.assert_allclose(scaled.F, plain.F * scale[NX + NU :, None] / scale[: NX + NU], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("n", [1, 2, 50])
def test_few_samples_and_a_small_pool_give_finite_models(n: int) -> None:
    samples = plant(n, system(1), np.random.default_rng(2))
    models, mode, residual = fit(samples, FitOptions(4, 1.0, 500.0, 1e-3))
    assert np.isfinite(models.F).all() and np.isfinite(models.P).all() and (models.variance >= 0).all()
    assert mode.shape == residual.shape == (n,) and np.isfinite(residual).all()


def test_the_fit_is_a_function_of_samples_and_generator() -> None:
    rng = np.random.default_rng(4)
    samples = np.vstack([plant(300, system(seed), rng, 0.3) for seed in range(3)])
    first, second = (fit(samples, FitOptions(4, 0.5, 50.0, 1e-3)) for _ in range(2))
    assert first[0].F.tobytes() == second[0].F.tobytes() and np.array_equal(first[1], second[1])


@pytest.mark.parametrize("outliers", [0.02, 0.2, 0.35])
@pytest.mark.parametrize("seed", range(3))
def test_the_first_mode_is_at_least_as_good_as_that_of_ransac_regressor(outliers: float, seed: int) -> None:
    """Planted inliers found, and error of the slopes, against scikit-learn with the same residual and subset size."""
    rng, n = np.random.default_rng(seed), 800
    samples = plant(n, system(1), rng, 0.05)
    planted = rng.random(n) >= outliers
    samples[~planted, NX + NU :] += rng.normal(0, 5, ((~planted).sum(), NX))
    options = FitOptions(modes=1, residual_threshold=0.35, prior_samples=0.0, ridge=1e-9)
    models, _, residual = fit(samples, options)
    reference = next(sklearn_modes(samples, NX, options))
    agreed = [(inlier == planted).mean() for inlier in (residual < options.residual_threshold, reference)]
    assert agreed[0] >= agreed[1] and agreed[0] > 0.99
    z, target = samples[reference, : NX + NU], samples[reference, NX + NU :]
    slopes = np.linalg.lstsq(z - z.mean(axis=0), target - target.mean(axis=0), rcond=None)[0].T
    ours, theirs = (np.sqrt(np.mean((F - system(1)) ** 2)) for F in (models.F[0], slopes))
    assert ours < 1.1 * theirs and ours < 0.01


def test_as_much_is_explained_as_by_recursive_ransac_regressor() -> None:
    rng = np.random.default_rng(7)
    samples = np.vstack([plant(n, system(seed), rng, 0.05) for seed, n in ((1, 500), (6, 300))])
    options = FitOptions(modes=2, residual_threshold=0.35, prior_samples=0.0, ridge=1e-9)
    _, _, residual = fit(samples, options)
    reference = np.any(list(sklearn_modes(samples, NX, options)), axis=0)
    assert (residual < options.residual_threshold).mean() >= max(float(reference.mean()), 0.99)
