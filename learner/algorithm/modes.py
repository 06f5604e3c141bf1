"""Modes of one class step by recursive RANSAC (paper Sec. III-E; FitLocalModels, Algorithm 2, line 6).

A mode is the best of several fits to subsets, refitted to its inliers; the next mode is fitted to the outliers. A
contact mode shares its departure from the pooled model, so most subsets are neighbourhoods in that departure (N
adjacent points sample consensus); uniform subsets of 64 or more rows would nearly always mix modes. In the end each
mode is fitted to the inliers that it explains best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from t6gps.learner.algorithm.regression import (
    Array,
    Bin,
    Mode,
    Models,
    Moments,
    Shrinkage,
    fit,
    in_units,
    residuals,
    stack,
    standardise,
)
from t6gps.learner.rows import Ints

UNIFORM_TRIALS = 4
LOCAL_TRIALS = 8
REFITS = 2
SMALLEST_SUBSET = 96
SUBSET_PER_REGRESSOR = 1.5
OUTLIERS_PER_REGRESSOR = 2
"""Outliers must outnumber the regressors by this factor to become a mode."""

Search = Callable[["Bin", "FitOptions", np.random.Generator], list[Mode]]
"""Finds at least one mode of a bin."""


def ransac(bin_: Bin, options: FitOptions, rng: np.random.Generator) -> list[Mode]:
    """Modes by recursive RANSAC: each is fitted to the outliers of the one before."""
    threshold, remaining, modes = options.residual_threshold, np.arange(len(bin_.a)), list[Mode]()
    while True:
        modes.append(mode := _consensus(bin_, remaining, threshold, rng))
        outliers = remaining[residuals(bin_, mode, remaining) >= threshold]
        few = len(outliers) < OUTLIERS_PER_REGRESSOR * bin_.regressor_n
        if len(modes) == options.modes or few or len(outliers) == len(remaining):
            break
        remaining = outliers
    if len(modes) > 1:
        # Inliers of an earlier mode may belong to a later one: each mode keeps those that it explains best.
        best, residual = _assign(bin_, modes)
        inlier = residual < threshold
        members = [np.flatnonzero(inlier & (best == number)) for number in range(len(modes))]
        modes = [fit(bin_, chosen, len(chosen)) for chosen in members if len(chosen)] or modes
    return modes


@dataclass(frozen=True)
class FitOptions:
    """See LearnerSettings for each; `search` is `ransac` or an alternative, a function that can be pickled."""

    modes: int
    residual_threshold: float
    prior_samples: float
    ridge: float
    search: Search = ransac


def fit_modes(
    samples: Array, state_n: int, prior: Moments, options: FitOptions, rng: np.random.Generator
) -> tuple[Models, Ints, Array]:
    """Modes of one class step, the mode of each sample [n] and its residual [n] in standard deviations.

    `samples` [n, 2 nx + nu] are joint vectors, n >= 1. The residual is the root mean square over the entries
    of x' of the error in units of the standard deviation among these samples, the velocity weighted to one
    half. Source: paper Sec. III-E.
    """
    bin_ = standardise(samples, state_n, prior, Shrinkage(options.prior_samples, options.ridge))
    modes = options.search(bin_, options, rng)
    best, residual = _assign(bin_, modes)
    return stack([in_units(bin_, mode) for mode in modes]), best, residual


def subset_size(regressor_n: int) -> int:
    """Samples that a trial is fitted to."""
    return max(SMALLEST_SUBSET, int(SUBSET_PER_REGRESSOR * regressor_n))


def _assign(bin_: Bin, modes: Sequence[Mode]) -> tuple[Ints, Array]:
    """The mode with the least residual of each sample, and that residual."""
    every = np.arange(len(bin_.a))
    under = np.stack([residuals(bin_, mode, every) for mode in modes])
    best = under.argmin(axis=0)
    return best, under[best, every]


def _consensus(bin_: Bin, chosen: Ints, threshold: float, rng: np.random.Generator) -> Mode:
    """The trial with the least truncated squared residual over rows [m], refitted to its inliers."""
    size = subset_size(bin_.regressor_n)
    if len(chosen) < 2 * size:
        mode = fit(bin_, chosen, len(chosen))
    else:
        stacked = fit(bin_, chosen[_subsets(bin_.departure[chosen], size, rng)], len(chosen))
        trials = [Mode(*parts) for parts in zip(stacked.mean, stacked.covariance, stacked.slopes, strict=True)]
        scores = [(np.minimum(residuals(bin_, trial, chosen), threshold) ** 2).sum() for trial in trials]
        mode = trials[int(np.argmin(scores))]
    for _ in range(REFITS):
        inliers = chosen[residuals(bin_, mode, chosen) < threshold]
        if len(inliers):
            mode = fit(bin_, inliers, len(inliers))
    return mode


def _subsets(departure: Array, size: int, rng: np.random.Generator) -> Ints:
    """Positions [trials, size]: uniform ones first, then neighbours of random rows in the departure [n, nx]."""
    n = len(departure)
    uniform = rng.random((UNIFORM_TRIALS, n)).argpartition(size - 1, axis=1)[:, :size]
    seeds = departure[rng.integers(n, size=LOCAL_TRIALS)]
    squares = np.einsum("ni,ni->n", departure, departure)
    local = (squares - 2 * seeds @ departure.T).argpartition(size - 1, axis=1)[:, :size]
    return np.concatenate([uniform, local])
