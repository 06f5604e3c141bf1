"""What the learner does, done the plain way: scikit-learn's RANSACRegressor, and a loop in double precision."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from t6gps.learner.algorithm import modes, regression
from t6gps.learner.algorithm.backward_pass import ACTION_VARIANCE_FLOOR_M2
from t6gps.learner.algorithm.regression import Array
from t6gps.learner.rows import Flags


def sklearn_modes(samples: Array, state_n: int, options: modes.FitOptions) -> Iterator[Flags]:
    """Inliers [n] of each mode, found one after the other by RANSACRegressor with the same subset size and residual.

    Its other settings are its defaults: 100 trials, and a refit to the inliers of the best.
    """
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    regressor_n = samples.shape[1] - state_n
    z, unit = samples[:, :regressor_n], regression.residual_unit(samples[:, regressor_n:].std(axis=0))
    target = samples[:, regressor_n:] / unit
    subset = modes.subset_size(regressor_n)
    remaining = np.arange(len(samples))
    for _ in range(options.modes):
        ransac = RANSACRegressor(
            LinearRegression(),
            min_samples=min(subset, len(remaining)),
            residual_threshold=options.residual_threshold,
            loss=lambda truth, predicted: np.sqrt(((truth - predicted) ** 2).sum(axis=1)),
            random_state=0,
        )
        ransac.fit(z[remaining], target[remaining])
        inliers = np.zeros(len(samples), dtype=bool)
        inliers[remaining[ransac.inlier_mask_]] = True
        yield inliers
        outliers = remaining[~ransac.inlier_mask_]
        if len(outliers) < modes.OUTLIERS_PER_REGRESSOR * regressor_n or len(outliers) == len(remaining):
            return
        remaining = outliers


class Gains(NamedTuple):
    """K [T, nu, nx], k [T, nu] and the predicted change of the cost of one sub-trajectory."""

    K: Array
    k: Array
    change: float


def plain_backward_pass(
    F: Array, P: Array, variance: float, kl_weight: float, gradient: Array, hessian: Array, deviation: Array
) -> Gains:
    """The backward pass of one sub-trajectory by the Riccati recursion.

    gradient [T, nx] and hessian [nx, nx] are those of the running cost; the rest is as in `backward_pass`.
    """
    length, nx, nu = len(F), F.shape[1], deviation.shape[1]
    K, k = np.zeros((length, nu, nx)), np.zeros((length, nu))
    precision = np.diag(np.full(nu, kl_weight / max(variance, ACTION_VARIANCE_FLOOR_M2)))
    V, v = hessian, gradient[-1]
    for t in reversed(range(length)):
        Fx, Fu = F[t][:, :nx], F[t][:, nx:]
        Quu = Fu.T @ V @ Fu + precision
        Qux = Fu.T @ V @ Fx - precision @ P[t]
        qu = Fu.T @ v + precision @ deviation[t]
        Qxx = Fx.T @ V @ Fx + P[t].T @ precision @ P[t]
        qx = Fx.T @ v - P[t].T @ precision @ deviation[t]
        K[t], k[t] = -np.linalg.solve(Quu, Qux), -np.linalg.solve(Quu, qu)
        V, v = Qxx + Qux.T @ K[t] + hessian, qx + Qux.T @ k[t] + (gradient[t - 1] if t else 0)
    dx, change = np.zeros(nx), 0.0
    for t in range(length):
        dx = F[t] @ np.concatenate([dx, k[t] + K[t] @ dx])
        change += gradient[t] @ dx + dx @ hessian @ dx / 2
    return Gains(K, k, change)
