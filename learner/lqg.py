"""Backward pass of linear-quadratic-Gaussian control with a KL term (paper Sec. II-A, III-F; Algorithm 2, line 10).

Sub-trajectories of equal length T are solved in one call; the first axis is the sub-trajectory, the second is time.
Everything is expressed in deviations around the recorded states x and actions u.

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

from t6gps.learner import _backward
from t6gps.learner.modes import Models
from t6gps.storage.errors import DataError

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

    K: NDArray[np.float32]
    k: NDArray[np.float32]
    predicted_cost_change: NDArray[np.float32]


@dataclass(frozen=True)
class LqgModels:
    """What the backward pass needs of each of k models: F and the KL terms c S^-1, c S^-1 P and c P' S^-1 P."""

    F: NDArray[np.float32]
    precision: NDArray[np.float32]
    precision_P: NDArray[np.float32]
    P_precision_P: NDArray[np.float32]


def prepare(models: Models, kl_weight: float, variance_m2: float | None = None) -> LqgModels:
    """Model table of the backward pass, in its single precision; `variance_m2` replaces the fitted S when given."""
    fitted = models.variance if variance_m2 is None else np.full_like(models.variance, variance_m2)
    precision = kl_weight / np.maximum(fitted, ACTION_VARIANCE_FLOOR_M2)
    precision_P = precision[:, :, None] * models.P
    both = np.swapaxes(models.P, 1, 2) @ precision_P
    return LqgModels(*map(_single, (models.F, precision, precision_P, both)))


def _single(array: Array) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, dtype=np.float32)


def backward_pass(models: LqgModels, model: Ints, gradient: Array, hessian: Array, deviation: Array) -> Improvement:
    """Improved local policies along sub-trajectories of one length (learner/native/backward.c).

    model      model of each step in the table [b, T]
    gradient   h of the state after each step [b, T, nx];   hessian   H [nx, nx]
    deviation  dev [b, T, nu]

    DataError if Quu is not positive definite somewhere, as with models that are not finite.
    """
    count, length, nx = gradient.shape
    nu = deviation.shape[2]
    found = Improvement(
        np.empty((count, length, nu, nx), dtype=np.float32),
        np.empty((count, length, nu), dtype=np.float32),
        np.empty((count, length), dtype=np.float32),
    )
    failed = _backward.improve(
        models.F,
        models.precision,
        models.precision_P,
        models.P_precision_P,
        np.ascontiguousarray(model, dtype=np.int64),
        _single(gradient),
        _single(hessian),
        _single(deviation),
        found.K,
        found.k,
        found.predicted_cost_change,
    )
    if failed >= 0:
        raise DataError(
            f"the backward pass cannot improve sub-trajectory {failed} of {count}, whose Quu is not positive definite; "
            "its models are not finite or too steep: use a larger learner.kl_weight or learner.prior_samples"
        )
    return found


def predicted_change(models: LqgModels, model: Ints, gradient: Array, hessian: Array, change: Array) -> Array:
    """Change of the running cost after each step [b, T] (m2/s2) when actions change by `change` [b, T, nu].

    What the models promise of actions from elsewhere, as `Improvement` does of those of the backward pass.
    """
    deviation, found = np.zeros_like(gradient[:, 0]), np.empty(model.shape, dtype=np.float32)
    for step in range(model.shape[1]):
        both = np.concatenate([deviation, change[:, step]], axis=1)
        deviation = np.einsum("bij,bj->bi", models.F[model[:, step]], both)
        found[:, step] = np.einsum("bi,bi->b", gradient[:, step] + deviation @ hessian / 2, deviation)
    return found


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
