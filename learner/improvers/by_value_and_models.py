"""Slopes of what follows an action, by the backward pass through local models that ends in a learned value.

The first-order part of LQG (paper Sec. II-A) along overlapping pieces of H steps, one from every row. In the action e,
what winches reach of a command in the step, models are x' = Fx x + Fe e + f with the policy e ~ P x + p, and

    lambda_1[t] = dr/dx + gamma dV/dx                  r = -cost / (2 v*)
    lambda_H[t] = dr/dx + gamma (Fx + Fe P)[t]' lambda_H-1[t+1]
    dR_H/de [t] = Fe[t]' lambda_H[t+1]

each in the state of its own row. V is the action value of the policy (`action_value`). Where the trajectory does not
continue, pieces are shorter. The slope is the mean over all lengths up to the longest.
"""

from __future__ import annotations

import numpy as np

from t6gps.learner.improvers.improver import Surrogate
from t6gps.learner.rows import NONE, Floats, Ints


def slopes(surrogate: Surrogate, value_slope: Floats, discount: float, horizon_steps: int) -> Floats:
    """dR/de [n, nu] (m/s) at all rows, zero without a dynamics sample.

    value_slope   dV/dx [n, nx] of the rows' states
    """
    rows, models = surrogate.rows, surrogate.series.models
    nx = rows.state.shape[1]
    groups = _groups(surrogate.series.of_row)
    closed = [
        (models.F[model, :, :nx] + models.F[model, :, nx:] @ models.P[model]).astype(np.float32) for model, _ in groups
    ]
    reward = _reward_slope(surrogate)
    costate = reward + np.float32(discount) * value_slope
    total, shortest = costate.copy(), costate
    for _ in range(horizon_steps - 1):
        following = shortest.copy()
        for (_, chosen), A in zip(groups, closed, strict=True):
            following[chosen] = reward[chosen] + np.float32(discount) * costate[chosen + 1] @ A
        costate = following
        total += costate
    total /= horizon_steps
    slope = np.zeros_like(rows.action)
    for model, chosen in groups:
        slope[chosen] = total[chosen + 1] @ models.F[model, :, nx:].astype(np.float32)
    return slope


def _reward_slope(surrogate: Surrogate) -> Floats:
    """dr/dx [n, nx] with r = -cost / (2 v*)."""
    spent = surrogate.residual_at(np.arange(len(surrogate.rows.acts))) @ surrogate.root().astype(np.float32)
    slope: Floats = spent / np.float32(-2 * surrogate.target_speed_m_per_s)
    return slope


def _groups(of_row: Ints) -> list[tuple[int, Ints]]:
    """The rows of each model that has any."""
    by_model = np.argsort(of_row, kind="stable")
    models, first = np.unique(of_row[by_model], return_index=True)
    parts = np.split(by_model, first[1:])
    return [(model, rows) for model, rows in zip(models.tolist(), parts, strict=True) if model != NONE]
