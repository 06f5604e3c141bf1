"""Modes as the components of a Gaussian mixture, to compare with RANSAC (paper Sec. III-E, which avoids its cost).

    a ~ sum over h of  w_h Normal(m_h, C_h),        a = [x; u; x'] standardised

by scikit-learn's GaussianMixture. It knows no prior; in its place each C_h is widened in the units of the pooled
covariance by

    ridge + n0 / (n0 + n / k)        the weight that n0 samples of the pool have beside the n / k of a component,

so that components with fewer samples than entries stay definite.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from t6gps.learner.algorithm.modes import FitOptions
from t6gps.learner.algorithm.regression import Array, Bin, Mode, fit
from t6gps.learner.rows import Ints

EM_ITERATIONS = 100
SMALLEST_VARIANCE = 1e-12
"""Of an entry that the pool does not vary in."""


def gaussian(bin_: Bin, options: FitOptions, rng: np.random.Generator) -> list[Mode]:
    """Modes from the components of a Gaussian mixture (in the place of `modes.ransac`)."""
    shrinkage = bin_.shrinkage
    members = components(bin_.a, bin_.pooled, options.modes, shrinkage.prior_samples, shrinkage.ridge, rng)
    return [fit(bin_, chosen, len(chosen)) for chosen in members]


def components(
    a: Array, pooled: Array, components_n: int, prior_samples: float, ridge: float, rng: np.random.Generator
) -> Sequence[Ints]:
    """Rows of `a` [n, na] in each component that is the likeliest for at least one of them.

    pooled [na, na] is the covariance that counts as `prior_samples` samples; `ridge` is added relative to its diagonal.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    n, count = len(a), min(components_n, len(a))
    seed = int(rng.integers(2**31))
    if count == 1:
        return [np.arange(n)]
    points = a / np.sqrt(np.maximum(pooled.diagonal(), SMALLEST_VARIANCE))
    widening = ridge + prior_samples / (prior_samples + n / count)
    mixture = GaussianMixture(count, reg_covar=widening, max_iter=EM_ITERATIONS, random_state=seed)
    with threadpool_limits(limits=1), warnings.catch_warnings():
        # Components that still change after EM_ITERATIONS are as good a division as any.
        warnings.simplefilter("ignore", ConvergenceWarning)
        likeliest = mixture.fit_predict(points)
    return [np.flatnonzero(likeliest == h) for h in range(count) if (likeliest == h).any()]
