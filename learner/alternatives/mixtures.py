"""Modes as the components of a Gaussian mixture, to compare with RANSAC (paper Sec. III-E, which avoids its cost).

    a ~ sum over h of  w_h Normal(m_h, C_h),        a = [x; u; x'] standardised

by expectation maximisation. Covariances are shrunk towards the pooled one C as the fits are, so that components with
fewer samples than entries stay definite.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

EM_ITERATIONS = 20
CONVERGED = 1e-4
"""Largest change of a responsibility at which the iteration ends."""


def components(
    a: Array, pooled: Array, components_n: int, prior_samples: float, ridge: float, rng: np.random.Generator
) -> Sequence[Ints]:
    """Rows of `a` [n, na] in each component that is the likeliest for at least one of them.

    pooled [na, na] is the covariance that counts as `prior_samples` samples; `ridge` is added relative to its diagonal.
    """
    n, count = len(a), min(components_n, len(a))
    centres = a[rng.choice(n, count, replace=False)]
    scale = np.maximum(pooled.diagonal(), 1e-12)
    distances = (((a[:, None] - centres) ** 2) / scale).sum(axis=2)
    shares = np.zeros((n, count))
    shares[np.arange(n), distances.argmin(axis=1)] = 1.0
    for _ in range(EM_ITERATIONS):
        logs = np.stack([_log_density(a, shares[:, h], pooled, prior_samples, ridge) for h in range(count)], axis=1)
        logs -= logs.max(axis=1, keepdims=True)
        before, shares = shares, np.exp(logs)
        shares /= shares.sum(axis=1, keepdims=True)
        if np.abs(shares - before).max() < CONVERGED:
            break
    likeliest = shares.argmax(axis=1)
    return [np.flatnonzero(likeliest == h) for h in range(count) if (likeliest == h).any()]


def _log_density(a: Array, share: Array, pooled: Array, prior_samples: float, ridge: float) -> Array:
    """log(w Normal(a; m, C)) [n] up to a constant, of the component in which samples have these shares."""
    weight = share.sum()
    if weight < 1e-9:
        return np.full(len(a), -np.inf)
    mean = share @ a / weight
    centred = a - mean
    own = (centred * share[:, None]).T @ centred
    covariance = (own + prior_samples * pooled) / (weight + prior_samples)
    covariance[np.diag_indices(len(mean))] += ridge * np.maximum(pooled.diagonal(), 1e-12)
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, centred.T)
    log: Array = np.log(weight) - np.log(root.diagonal()).sum() - (whitened**2).sum(axis=0) / 2
    return log
