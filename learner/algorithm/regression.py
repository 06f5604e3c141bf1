"""Linear models of samples, shrunk towards a pooled model (paper Sec. III-D; FitLocalModels, Algorithm 2, line 6).

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.rows import PIECE_ROWS, VELOCITY_N, Ints, Rows, pieces

Array = NDArray[np.float64]

COST_STATE_SHARE = 0.5
"""Share of the velocity in the squared residual: what the cost depends on counts as much as all the rest."""
DISTINCT_SPREAD = 1e-3
"""Least spread of an entry of x' in a bin, in units of the pooled one: where it hardly varies, rounding must not make
outliers."""


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
class Shrinkage:
    """How far fits are pulled: n0 samples of the pool, and the ridge relative to the variance of a regressor."""

    prior_samples: float
    ridge: float


@dataclass(frozen=True)
class Bin:
    """Standardised samples of one class step; x' is scaled so that the norm of its error is the residual.

    a [n, na]; raw = centre + unit * a; pooled covariance C in these units; departure [n, nx] of x' from the
    pooled model; regressor_n entries z come before x'.
    """

    a: Array
    centre: Array
    unit: Array
    pooled: Array
    departure: Array
    regressor_n: int
    shrinkage: Shrinkage

    @property
    def state_n(self) -> int:
        """Entries of x and of x'."""
        return self.a.shape[1] - self.regressor_n


@dataclass(frozen=True)
class Mode:
    """Mean [na], covariance [na, na] with the prior, and dynamics slopes [nz, nx] of one mode, standardised."""

    mean: Array
    covariance: Array
    slopes: Array


def moments(samples: Array) -> Moments:
    """Mean and covariance of at least one joint vector [n, na]."""
    centred = samples - (mean := samples.mean(axis=0))
    return Moments(len(samples), mean, centred.T @ centred / len(samples))


def pooled_moments(rows: Rows, chosen: Ints, piece_rows: int = PIECE_ROWS) -> Moments:
    """Moments of the joint vectors of rows [m] that continue, m >= 1; in pieces, since there may be a million."""
    n, parts = len(chosen), pieces(chosen, piece_rows)
    mean = np.sum([rows.samples(part).astype(np.float64).sum(axis=0) for part in parts], axis=0) / n

    def squares(part: Ints) -> Array:
        centred = rows.samples(part).astype(np.float64)
        centred -= mean
        return centred.T @ centred

    return Moments(n, mean, np.sum([squares(part) for part in parts], axis=0) / n)


def stack(models: Sequence[Models]) -> Models:
    """One table of all models, in order."""
    return Models(*(np.concatenate([getattr(m, name) for m in models]) for name in ("F", "f", "P", "p", "variance")))


def standardise(samples: Array, state_n: int, prior: Moments, shrinkage: Shrinkage) -> Bin:
    """A bin of joint vectors [n, na], n >= 1, of a class step."""
    regressor_n = samples.shape[1] - state_n
    pooled_scale = np.sqrt(prior.covariance.diagonal())
    pooled_scale = np.where(pooled_scale > 1e-9, pooled_scale, 1.0)
    spread = np.maximum(samples[:, regressor_n:].std(axis=0), DISTINCT_SPREAD * pooled_scale[regressor_n:])
    unit = np.concatenate([pooled_scale[:regressor_n], residual_unit(spread)])
    centre = samples.mean(axis=0)
    a, pooled = (samples - centre) / unit, prior.covariance / np.outer(unit, unit)
    # A pool of hardly more samples than regressors determines nothing: its slopes fade out, steeply.
    ridge = shrinkage.ridge + (regressor_n / prior.count) ** 4
    departure = a[:, regressor_n:] - a[:, :regressor_n] @ _slopes(pooled, regressor_n, ridge)
    return Bin(a, centre, unit, pooled, departure, regressor_n, Shrinkage(shrinkage.prior_samples, ridge))


def residual_unit(spread: Array) -> Array:
    """Units of x' [nx] in which the norm of an error is its residual, from standard deviations [nx]."""
    share = np.full(len(spread), (1 - COST_STATE_SHARE) / max(len(spread) - VELOCITY_N, 1))
    share[:VELOCITY_N] = (COST_STATE_SHARE if len(spread) > VELOCITY_N else 1.0) / VELOCITY_N
    unit: Array = spread / np.sqrt(share)
    return unit


def _slopes(covariance: Array, regressor_n: int, ridge: float) -> Array:
    left = covariance[..., :regressor_n, :regressor_n] + ridge * np.eye(regressor_n)
    return np.asarray(np.linalg.solve(left, covariance[..., :regressor_n, regressor_n:]), dtype=np.float64)


def fit(bin_: Bin, subsets: Ints, weight: int) -> Mode:
    """Fits to rows `subsets` [..., m], each standing for `weight` samples against the n0 of the prior."""
    a = bin_.a[subsets]
    mean = a.mean(axis=-2)
    centred = a - mean[..., None, :]
    within = np.swapaxes(centred, -1, -2) @ centred / subsets.shape[-1]
    prior_samples = bin_.shrinkage.prior_samples
    covariance = (weight * within + prior_samples * bin_.pooled) / (weight + prior_samples)
    return Mode(mean, covariance, _slopes(covariance, bin_.regressor_n, bin_.shrinkage.ridge))


def residuals(bin_: Bin, mode: Mode, chosen: Ints) -> Array:
    """Residuals [m] of rows [m] under a mode."""
    n, a = bin_.regressor_n, bin_.a[chosen]
    offset = mode.mean[None, n:] - mode.mean[None, :n] @ mode.slopes
    error = a[:, n:] - a[:, :n] @ mode.slopes - offset
    return np.sqrt(np.einsum("...i,...i->...", error, error))


def in_units(bin_: Bin, mode: Mode) -> Models:
    """One mode as a table with one model, in the units of the samples."""
    n, nx, unit = bin_.regressor_n, bin_.state_n, bin_.unit
    mean = bin_.centre + unit * mode.mean
    F = (mode.slopes / unit[:n, None] * unit[n:]).T
    within = mode.covariance[:n, :n]
    gain = _slopes(within, nx, bin_.shrinkage.ridge)
    variance = (within[nx:, nx:] - 2 * gain.T @ within[:nx, nx:] + gain.T @ within[:nx, :nx] @ gain).diagonal()
    P = (gain / unit[:nx, None] * unit[nx:n]).T
    f, p = mean[n:] - F @ mean[:n], mean[nx:n] - P @ mean[:nx]
    return Models(F[None], f[None], P[None], p[None], (np.maximum(variance, 0.0) * unit[nx:n] ** 2)[None])
