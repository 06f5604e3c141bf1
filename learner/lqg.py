"""Backward pass of linear-quadratic-Gaussian control with a KL term (paper Sec. II-A, III-F; Algorithm 2, line 10).

All sub-trajectories of equal length T are solved at once; the first axis is the sub-trajectory, the second is
time. Everything is expressed in deviations around the recorded states x and actions u.

    F          slopes of the surrogate dynamics      dx[t+1] = F[t] [dx[t]; du[t]],  F = [Fx Fu]
    P, S       surrogate policy                      slopes and (diagonal) covariance
    dev        recorded action minus policy mean     [T, nu]
    H, h[t]    Hessian and gradient of the running cost of the state after step t
    c          weight of the KL term, for equal covariances 1/2 e' S^-1 e with e = dev + du - P dx
    V, v       Hessian and gradient of the cost-to-go of the state after the step, with its own running cost

    Quu = Fu' V Fu + c S^-1        Qux = Fu' V Fx - c S^-1 P        qu = Fu' v + c S^-1 dev
    Qxx = Fx' V Fx + c P' S^-1 P                                    qx = Fx' v - c P' S^-1 dev
    K = -Quu^-1 Qux,   k = -Quu^-1 qu,   V <- Qxx + Qxu K + H,   v <- qx + Qxu k + h

The improved policy is u* = u + k + K dx; at the recorded states u* = u + k. Actions cost nothing by
themselves: Quu is definite through the KL term alone, so S needs the floor below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.modes import Models

Array = NDArray[np.floating]
Ints = NDArray[np.int64]

ACTION_VARIANCE_FLOOR_M2 = 1e-4
"""No policy counts as more certain than 1 cm per cable."""


@dataclass(frozen=True)
class Improvement:
    """Improved policies of b sub-trajectories: K [b, T, nu, nx], k [b, T, nu], and what the models promise.

    predicted_cost_change   change of the running cost of the state after each step, KL term not included, when u*
                            acts from the recorded first state on in the surrogate models [b, T] (m2/s2)
    """

    K: Array
    k: Array
    predicted_cost_change: Array


@dataclass(frozen=True)
class LqgModels:
    """What the backward pass needs of each of k models: F and the KL terms c S^-1, c S^-1 P and c P' S^-1 P."""

    F: Array
    precision: Array
    precision_P: Array
    P_precision_P: Array


def prepare(
    models: Models, kl_weight: float, variance_m2: float | None = None, dtype: type[np.floating] = np.float32
) -> LqgModels:
    """Model table of the backward pass, which has its precision; `variance_m2` replaces the fitted S when given."""
    fitted = models.variance if variance_m2 is None else np.full_like(models.variance, variance_m2)
    precision = kl_weight / np.maximum(fitted, ACTION_VARIANCE_FLOOR_M2)
    precision_P = precision[:, :, None] * models.P
    both = np.swapaxes(models.P, 1, 2) @ precision_P
    return LqgModels(*(array.astype(dtype) for array in (models.F, precision, precision_P, both)))


def backward_pass(models: LqgModels, model: Ints, gradient: Array, hessian: Array, deviation: Array) -> Improvement:
    """Improved local policies along sub-trajectories of one length.

    model      model of each step in the table [b, T]
    gradient   h of the state after each step [b, T, nx];   hessian   H [nx, nx]
    deviation  dev [b, T, nu]
    """
    count, length, nx = gradient.shape
    nu = deviation.shape[2]
    K = np.empty((count, length, nu, nx), dtype=models.F.dtype)
    k = np.empty((count, length, nu), dtype=models.F.dtype)
    gradient, hessian, deviation = (array.astype(K.dtype, copy=False) for array in (gradient, hessian, deviation))
    V = np.broadcast_to(hessian, (count, nx, nx))
    v = gradient[:, -1]
    for t in reversed(range(length)):
        F, pull = models.F[model[:, t]], models.precision[model[:, t]]
        Q = np.swapaxes(F, 1, 2) @ (V @ F)
        q = (v[:, None] @ F)[:, 0]
        weighted_P = models.precision_P[model[:, t]]
        Quu = Q[:, nx:, nx:]
        Quu[:, np.arange(nu), np.arange(nu)] += pull
        Qux = Q[:, nx:, :nx] - weighted_P
        qu = q[:, nx:] + pull * deviation[:, t]
        gains = -np.linalg.solve(Quu, np.concatenate([Qux, qu[:, :, None]], axis=2))
        K[:, t], k[:, t] = gains[:, :, :nx], gains[:, :, nx]
        if t == 0:
            break
        Qxu = np.swapaxes(Qux, 1, 2)
        V = Q[:, :nx, :nx] + models.P_precision_P[model[:, t]] + Qxu @ K[:, t]
        V = (V + np.swapaxes(V, 1, 2)) / 2 + hessian
        qx = q[:, :nx] - (deviation[:, t, None] @ weighted_P)[:, 0]
        v = qx + (Qxu @ k[:, t, :, None])[:, :, 0] + gradient[:, t - 1]
    return Improvement(K, k, _predicted_change(models, model, gradient, hessian, K, k))


def _predicted_change(models: LqgModels, model: Ints, gradient: Array, hessian: Array, K: Array, k: Array) -> Array:
    """Forward pass: what the improved policy changes in the running cost [b, T], by the models."""
    dx = np.zeros_like(gradient[:, 0])
    change = np.empty(gradient.shape[:2], dtype=gradient.dtype)
    for t in range(gradient.shape[1]):
        du = k[:, t] + (K[:, t] @ dx[:, :, None])[:, :, 0]
        dx = (models.F[model[:, t]] @ np.concatenate([dx, du], axis=1)[:, :, None])[:, :, 0]
        change[:, t] = ((gradient[:, t] + dx @ hessian / 2) * dx).sum(axis=1)
    return change


def sub_trajectories(continues: NDArray[np.bool_], horizon_steps: int) -> dict[int, Ints]:
    """First rows of all sub-trajectories by their length (paper Sec. III-F; GetSubTrajectories of Algorithm 2).

    Runs of rows that lead to the next row [n] are divided into consecutive pieces of `horizon_steps`; the
    last piece of a run may be shorter.
    """
    index = np.flatnonzero(continues)
    run = np.cumsum(np.diff(index, prepend=-2) > 1)
    age = np.arange(len(index)) - np.flatnonzero(np.diff(run, prepend=0))[run - 1]
    begins = np.flatnonzero(age % horizon_steps == 0)
    lengths = np.diff(begins, append=len(index))
    return {int(length): index[begins[lengths == length]] for length in np.unique(lengths)}
