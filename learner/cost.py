"""Running cost (paper Sec. IV-A) as a function of the reduced state x, whose first entries are the velocity v.

l(x) = (v - v* g)' W (v - v* g) = |r|^2 / 2,    W = diag(1, 1, w),    g = (target direction, 0)

r = D (v - v* g) with D = (2 W)^1/2 is linear in x: the cost is that of a least squares problem.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.rows import VELOCITY_N

Array = NDArray[np.floating]


def residual(state: Array, target: Array, target_speed_m_per_s: float, vertical_weight: float) -> Array:
    """r [..., 3] of states [..., nx] and horizontal target directions [..., 2] (m/s)."""
    error = state[..., :VELOCITY_N].copy()
    error[..., :2] -= target_speed_m_per_s * target
    scaled: Array = error * _scale(vertical_weight).astype(state.dtype)
    return scaled


def root(state_n: int, vertical_weight: float) -> Array:
    """D as the constant slope dr/dx [3, nx]."""
    slope = np.zeros((VELOCITY_N, state_n))
    np.fill_diagonal(slope, _scale(vertical_weight))
    return slope


def _scale(vertical_weight: float) -> Array:
    scale: Array = np.sqrt(2 * np.array([1.0, 1.0, vertical_weight]))
    return scale


def running_cost(state: Array, target: Array, target_speed_m_per_s: float, vertical_weight: float) -> Array:
    """l [...] of states [..., nx] and horizontal target directions [..., 2] (m2/s2)."""
    value: Array = np.square(residual(state, target, target_speed_m_per_s, vertical_weight)).sum(axis=-1) / 2
    return value
