"""Running cost (paper Sec. IV-A) as a function of the reduced state x, whose first entries are the velocity v.

l(x) = (v - v* g)' W (v - v* g),    W = diag(1, 1, w),    g = (target direction, 0)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.features import VELOCITY_N

Array = NDArray[np.floating]


def _error(state: Array, target: Array, target_speed_m_per_s: float) -> Array:
    error = state[..., :VELOCITY_N].copy()
    error[..., :2] -= target_speed_m_per_s * target
    return error


def running_cost(state: Array, target: Array, target_speed_m_per_s: float, vertical_weight: float) -> Array:
    """l [...] of states [..., nx] and horizontal target directions [..., 2] (m2/s2)."""
    weights = np.array([1.0, 1.0, vertical_weight], dtype=state.dtype)
    value: Array = (_error(state, target, target_speed_m_per_s) ** 2 * weights).sum(axis=-1)
    return value


def gradient(state: Array, target: Array, target_speed_m_per_s: float, vertical_weight: float) -> Array:
    """dl/dx [..., nx]."""
    weights = np.array([1.0, 1.0, vertical_weight], dtype=state.dtype)
    slope = np.zeros_like(state)
    slope[..., :VELOCITY_N] = 2 * weights * _error(state, target, target_speed_m_per_s)
    return slope


def hessian(state_n: int, vertical_weight: float) -> Array:
    """The constant second derivative of l [nx, nx]."""
    diagonal = np.zeros(state_n)
    diagonal[:VELOCITY_N] = [2.0, 2.0, 2.0 * vertical_weight]
    return np.diag(diagonal)
