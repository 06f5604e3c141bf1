"""Backward pass of linear-quadratic-Gaussian control with a KL term (Sec. II-A, III-F).

LQGBackwardPass, line 10 of Algorithm 2.

Sub-trajectories of equal length T are solved in one call; the first axis is the sub-trajectory, the second is time.
Everything is expressed in deviations around the recorded states x and actions u.

    F          slopes of the surrogate dynamics      dx[t+1] = F[t] [dx[t]; du[t]],  F = [Fx Fu]
    P, S       surrogate policy                      slopes and (diagonal) covariance
    dev        recorded action minus policy mean     [T, nu]
    D, r[t]    running cost of the state after step t, |r[t] + D dx[t+1]|^2 / 2
    c          weight of the KL term, for equal covariances 1/2 e' R e with e = dev + du - P dx, R = c S^-1

The cost-to-go is a sum of squares as well, |l + L dx|^2 / 2, and in terms of e, with du = e + P dx - dev, a step is a
least squares problem in e. Going back from L = D, l = r[T-1]:

    Gu = L Fu    Gx = L (Fx + Fu P)    g = l - Gu dev      the cost-to-go as a function of dx and e
    M = I + Gu R^-1 Gu' = U'U
    K = P - R^-1 Gu' M^-1 Gx           k = -dev - R^-1 Gu' M^-1 g
    L <- [U^-T Gx; D]                  l <- [U^-T g; r[t-1]]

These are the gains of the Riccati recursion with V = L'L, by the matrix inversion lemma (Quu = Gu'Gu + R). M is as
large as L has rows, three more at each step back; longer L than nx are brought to a triangle by Householder
reflections. Nothing is subtracted, and M is definite whatever the models are.

The improved policy is u* = u + k + K dx; at the recorded states u* = u + k. Actions cost nothing by themselves, so S
needs the floor below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner import _backward
from t6gps.learner.algorithm.regression import Models
from t6gps.learner.rows import Floats, Ints
from t6gps.storage.errors import DataError

Array = NDArray[np.floating]

ACTION_VARIANCE_FLOOR_M2 = 1e-4
"""No policy counts as more certain than 1 cm per cable."""
COLUMNS = 16
"""Rows of F are a multiple of it (learner/native/backward.c)."""


@dataclass(frozen=True)
class Improvement:
    """Improved policies of b sub-trajectories: K [b, T, nu, nx], k [b, T, nu], and what the models promise.

    predicted_cost_change   change of the running cost of the state after each step, KL term not included, when u*
                            acts from the recorded first state on in the surrogate models [b, T] (m2/s2)
    """

    K: Floats
    k: Floats
    predicted_cost_change: Floats


@dataclass(frozen=True)
class LqgModels:
    """What the backward pass needs of each of k models.

    F           slopes [Fx + Fu P, 0, Fu] with respect to dx, to the constant 1 (none) and to e, columns of zeros after
                them [k, nx, a multiple of 16]
    R_inverse   S / c [k, nu];   P [k, nu, nx]
    """

    F: Floats
    R_inverse: Floats
    P: Floats


def prepare(models: Models, kl_weight: float, variance_m2: float | None = None) -> LqgModels:
    """Model table of the backward pass, in its single precision; `variance_m2` replaces the fitted S when given."""
    fitted = models.variance if variance_m2 is None else np.full_like(models.variance, variance_m2)
    count, nu, nx = models.P.shape
    Fx, Fu = models.F[:, :, :nx], models.F[:, :, nx:]
    F = np.zeros((count, nx, -(-(nx + 1 + nu) // COLUMNS) * COLUMNS), dtype=np.float32)
    F[:, :, :nx] = Fx + Fu @ models.P
    F[:, :, nx + 1 : nx + 1 + nu] = Fu
    return LqgModels(F, _single(np.maximum(fitted, ACTION_VARIANCE_FLOOR_M2) / kl_weight), _single(models.P))


def _single(array: Array) -> Floats:
    return np.ascontiguousarray(array, dtype=np.float32)


def backward_pass(models: LqgModels, model: Ints, residual: Array, root: Array, deviation: Array) -> Improvement:
    """Improved local policies along sub-trajectories of one length (learner/native/backward.c).

    model      model of each step in the table [b, T]
    residual   r of the state after each step [b, T, m];   root   D [m, nx]
    deviation  dev [b, T, nu]

    DataError where no gains exist, as with models that are not finite.
    """
    (count, length), (nu, nx) = model.shape, models.P.shape[1:]
    improvement = Improvement(
        np.empty((count, length, nu, nx), dtype=np.float32),
        np.empty((count, length, nu), dtype=np.float32),
        np.empty((count, length), dtype=np.float32),
    )
    failed = _backward.improve(
        models.F,
        models.R_inverse,
        models.P,
        np.ascontiguousarray(model, dtype=np.int64),
        _single(residual),
        _single(root),
        _single(deviation),
        improvement.K,
        improvement.k,
        improvement.predicted_cost_change,
    )
    if failed >= 0:
        raise DataError(
            f"the backward pass cannot improve sub-trajectory {failed} of {count}: its models are not finite or too "
            "steep for single precision; use a larger learner.prior_samples or learner.kl_weight"
        )
    return improvement


def predicted_change(F: Array, model: Ints, residual: Array, root: Array, change: Array) -> Floats:
    """Change of the running cost after each step [b, T] (m2/s2) when actions change by `change` [b, T, nu].

    What models of slopes F [k, nx, nx + nu] promise of actions from elsewhere, as `Improvement` does of those of the
    backward pass; the other arguments are its own.
    """
    dx, predicted = np.zeros((len(model), F.shape[1]), dtype=np.float32), np.empty(model.shape, dtype=np.float32)
    for step, chosen in enumerate(model.T):
        dx = np.einsum("bij,bj->bi", F[chosen], np.concatenate([dx, change[:, step]], axis=1))
        more = dx @ root.T
        predicted[:, step] = np.einsum("bi,bi->b", more, residual[:, step] + more / 2)
    return predicted
