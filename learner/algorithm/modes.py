"""Multi-modal linear models of one class step (paper Sec. III-E), shrunk towards a pooled model.

Each sample is a joint vector a = [x; u; x'] with z = [x; u]; a mode h is a Gaussian of such vectors and
yields

    x' = F z + f                  surrogate dynamics
    u ~ Normal(P x + p, S)        surrogate policy, S diagonal

The covariance of a mode with n samples is (n cov(a) + n0 C) / (n + n0), where C is the covariance pooled over
the kind (over kind and exit for crossings): the pooled data count as n0 further samples. Slopes then solve

    (n cov_zz + n0 C_zz + (n + n0) ridge) F' = n cov_zx' + n0 C_zx' = n cov_zx' + n0 C_zz F_pooled',

a ridge solution pulled towards the pooled one in the metric of the pooled data. Both covariances are centred,
each on its own mean: where a bin lies relative to the pool must not be read as a slope; the mean of a mode is
its own.

Modes come from recursive RANSAC: a mode is the best of several fits to subsets, refitted to its inliers; the
next mode is fitted to the outliers. A contact mode shares its departure from the pooled model, so most
subsets are neighbourhoods in that departure (N adjacent points sample consensus); uniform subsets of 64 or
more rows would nearly always mix modes. In the end each mode is fitted to the inliers that it explains best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import VELOCITY_N
from t6gps.learner.alternatives import mixtures
from t6gps.learner.settings import ModeSearch

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

UNIFORM_TRIALS, LOCAL_TRIALS, REFITS = 4, 8, 2
SMALLEST_SUBSET = 96
SUBSET_PER_REGRESSOR = 1.5
OUTLIERS_PER_REGRESSOR = 2
"""Outliers must outnumber the regressors by this factor to become a mode."""
COST_STATE_SHARE = 0.5
"""Share of the velocity in the squared residual: what the cost depends on counts as much as all the rest."""


@dataclass(frozen=True)
class Moments:
    """Mean [na] and covariance [na, na] of `count` joint vectors a = [x; u; x']."""

    count: int
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Models:
    """k surrogate models: F [k, nx, nx + nu], f [k, nx], P [k, nu, nx], p [k, nu], variance diag S [k, nu]."""

    F: Array
    f: Array
    P: Array
    p: Array
    variance: Array

    def __len__(self) -> int:
        return len(self.F)


@dataclass(frozen=True)
class FitOptions:
    """See LearnerSettings for each."""

    modes: int
    residual_threshold: float
    prior_samples: float
    ridge: float
    search: ModeSearch = ModeSearch.RANSAC


def moments(samples: Array) -> Moments:
    """Mean and covariance of at least one joint vector [n, na]."""
    centred = samples - (mean := samples.mean(axis=0))
    return Moments(len(samples), mean, centred.T @ centred / len(samples))


def stack(models: Sequence[Models]) -> Models:
    """One table of all models, in order."""
    return Models(*(np.concatenate([getattr(m, name) for m in models]) for name in ("F", "f", "P", "p", "variance")))


def fit_modes(
    samples: Array, state_n: int, prior: Moments, options: FitOptions, rng: np.random.Generator
) -> tuple[Models, Ints, Array]:
    """Modes of one class step, the mode of each sample [n] and its residual [n] in standard deviations.

    `samples` [n, 2 nx + nu] are joint vectors, n >= 1. The residual is the root mean square over the entries
    of x' of the error in units of the standard deviation among these samples, the velocity weighted to one
    half. Source: paper Sec. III-E.
    """
    bin_ = _standardise(samples, state_n, prior, options)
    modes = _recursive(bin_, rng) if options.search is ModeSearch.RANSAC else _mixture(bin_, rng)
    best, residual = _assign(bin_, modes)
    return stack([_in_units(bin_, mode) for mode in modes]), best, residual


def _mixture(bin_: _Bin, rng: np.random.Generator) -> list[_Mode]:
    """Modes from the components of a Gaussian mixture."""
    options = bin_.options
    rows = mixtures.components(bin_.a, bin_.pooled, options.modes, options.prior_samples, bin_.ridge, rng)
    return [_fit(bin_, own, len(own)) for own in rows]


def _recursive(bin_: _Bin, rng: np.random.Generator) -> list[_Mode]:
    """Modes by recursive RANSAC: each is fitted to the outliers of the one before."""
    options, remaining, modes = bin_.options, np.arange(len(bin_.a)), list[_Mode]()
    while True:
        modes.append(mode := _consensus(bin_, remaining, rng))
        outliers = remaining[_residuals(bin_, mode, remaining) >= options.residual_threshold]
        few = len(outliers) < OUTLIERS_PER_REGRESSOR * bin_.regressor_n
        if len(modes) == options.modes or few or len(outliers) == len(remaining):
            break
        remaining = outliers
    if len(modes) > 1:
        # Inliers of an earlier mode may belong to a later one: each mode keeps those that it explains best.
        best, residual = _assign(bin_, modes)
        inlier = residual < options.residual_threshold
        own = [np.flatnonzero(inlier & (best == number)) for number in range(len(modes))]
        modes = [_fit(bin_, rows, len(rows)) for rows in own if len(rows)] or modes
    return modes


def _assign(bin_: _Bin, modes: Sequence[_Mode]) -> tuple[Ints, Array]:
    """The mode with the least residual of each sample, and that residual."""
    residuals = np.stack([_residuals(bin_, mode, np.arange(len(bin_.a))) for mode in modes])
    best = residuals.argmin(axis=0)
    return best, residuals[best, np.arange(len(best))]


@dataclass(frozen=True)
class _Bin:
    """Standardised samples of one class step; x' is scaled so that the norm of its error is the residual.

    a [n, na]; raw = centre + unit * a; pooled covariance C in these units; departure [n, nx] of x' from the
    pooled model.
    """

    a: Array
    centre: Array
    unit: Array
    pooled: Array
    ridge: float
    state_n: int
    departure: Array
    options: FitOptions

    @property
    def regressor_n(self) -> int:
        return self.a.shape[1] - self.state_n


@dataclass(frozen=True)
class _Mode:
    """Mean [na], covariance [na, na] with the prior, and dynamics slopes [nz, nx] of one mode, standardised."""

    mean: Array
    covariance: Array
    slopes: Array


def _standardise(samples: Array, state_n: int, prior: Moments, options: FitOptions) -> _Bin:
    regressor_n = samples.shape[1] - state_n
    pooled_scale = np.sqrt(prior.covariance.diagonal())
    pooled_scale = np.where(pooled_scale > 1e-9, pooled_scale, 1.0)
    # A bin in which an entry hardly varies must not turn rounding into outliers.
    spread = np.maximum(samples[:, regressor_n:].std(axis=0), 1e-3 * pooled_scale[regressor_n:])
    unit = np.concatenate([pooled_scale[:regressor_n], residual_unit(spread)])
    centre = samples.mean(axis=0)
    a, pooled = (samples - centre) / unit, prior.covariance / np.outer(unit, unit)
    # A pool of hardly more samples than regressors determines nothing: its slopes fade out, steeply.
    ridge = options.ridge + (regressor_n / prior.count) ** 4
    departure = a[:, regressor_n:] - a[:, :regressor_n] @ _slopes(pooled, regressor_n, ridge)
    return _Bin(a, centre, unit, pooled, ridge, state_n, departure, options)


def residual_unit(spread: Array) -> Array:
    """Units of x' [nx] in which the norm of an error is its residual, from standard deviations [nx]."""
    share = np.full(len(spread), (1 - COST_STATE_SHARE) / max(len(spread) - VELOCITY_N, 1))
    share[:VELOCITY_N] = (COST_STATE_SHARE if len(spread) > VELOCITY_N else 1.0) / VELOCITY_N
    unit: Array = spread / np.sqrt(share)
    return unit


def _slopes(covariance: Array, regressor_n: int, ridge: float) -> Array:
    left = covariance[..., :regressor_n, :regressor_n] + ridge * np.eye(regressor_n)
    return np.asarray(np.linalg.solve(left, covariance[..., :regressor_n, regressor_n:]), dtype=np.float64)


def _fit(bin_: _Bin, subsets: Ints, weight: int) -> _Mode:
    """Fits to rows `subsets` [..., m], each standing for `weight` samples against the n0 of the prior."""
    a = bin_.a[subsets]
    mean = a.mean(axis=-2)
    centred = a - mean[..., None, :]
    own = np.swapaxes(centred, -1, -2) @ centred / subsets.shape[-1]
    prior_samples = bin_.options.prior_samples
    covariance = (weight * own + prior_samples * bin_.pooled) / (weight + prior_samples)
    return _Mode(mean, covariance, _slopes(covariance, bin_.regressor_n, bin_.ridge))


def _residuals(bin_: _Bin, mode: _Mode, rows: Ints) -> Array:
    """Residuals [..., m] of rows [m] under one mode, or under each of a stack of them."""
    n, a = bin_.regressor_n, bin_.a[rows]
    offset = mode.mean[..., None, n:] - mode.mean[..., None, :n] @ mode.slopes
    error = a[:, n:] - a[:, :n] @ mode.slopes - offset
    return np.sqrt(np.einsum("...i,...i->...", error, error))


def _consensus(bin_: _Bin, rows: Ints, rng: np.random.Generator) -> _Mode:
    """The trial with the least truncated squared residual over `rows`, refitted to its inliers."""
    threshold = bin_.options.residual_threshold
    subset = max(SMALLEST_SUBSET, int(SUBSET_PER_REGRESSOR * bin_.regressor_n))
    if len(rows) < 2 * subset:
        mode = _fit(bin_, rows, len(rows))
    else:
        trials = _fit(bin_, rows[_subsets(bin_.departure[rows], subset, rng)], len(rows))
        scores = np.minimum(_residuals(bin_, trials, rows), threshold) ** 2
        best = scores.sum(axis=1).argmin()
        mode = _Mode(trials.mean[best], trials.covariance[best], trials.slopes[best])
    for _ in range(REFITS):
        inliers = rows[_residuals(bin_, mode, rows) < threshold]
        if len(inliers):
            mode = _fit(bin_, inliers, len(inliers))
    return mode


def _subsets(departure: Array, size: int, rng: np.random.Generator) -> Ints:
    """Positions [trials, size]: uniform ones first, then neighbours of random rows in the departure [n, nx]."""
    n = len(departure)
    uniform = rng.random((UNIFORM_TRIALS, n)).argpartition(size - 1, axis=1)[:, :size]
    seeds = departure[rng.integers(n, size=LOCAL_TRIALS)]
    squares = np.einsum("ni,ni->n", departure, departure)
    local = (squares - 2 * seeds @ departure.T).argpartition(size - 1, axis=1)[:, :size]
    return np.concatenate([uniform, local])


def _in_units(bin_: _Bin, mode: _Mode) -> Models:
    """One mode as a table with one model, in the units of the samples."""
    n, nx, unit = bin_.regressor_n, bin_.state_n, bin_.unit
    mean = bin_.centre + unit * mode.mean
    F = (mode.slopes / unit[:n, None] * unit[n:]).T
    within = mode.covariance[:n, :n]
    gain = _slopes(within, nx, bin_.ridge)
    variance = (within[nx:, nx:] - 2 * gain.T @ within[:nx, nx:] + gain.T @ within[:nx, :nx] @ gain).diagonal()
    P = (gain / unit[:nx, None] * unit[nx:n]).T
    f, p = mean[n:] - F @ mean[:n], mean[nx:n] - P @ mean[:nx]
    return Models(F[None], f[None], P[None], p[None], (np.maximum(variance, 0.0) * unit[nx:n] ** 2)[None])
