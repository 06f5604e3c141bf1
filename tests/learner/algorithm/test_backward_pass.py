"""Laws of the backward pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm.backward_pass import Improvement, backward_pass, predicted_change, prepare
from t6gps.learner.algorithm.regression import Models
from t6gps.learner.bench.references import plain_backward_pass
from t6gps.storage.errors import DataError

NX, NU, T, B, C = 5, 3, 6, 4, 0.05
Array = NDArray[np.float64]


@dataclass
class Problem:
    """B random sub-trajectories of T steps; each step has a model of its own."""

    models: Models
    index: NDArray[np.int64]
    residual: Array
    root: Array
    deviation: Array

    def solve(self) -> Improvement:
        return backward_pass(prepare(self.models, C), self.index, self.residual, self.root, self.deviation)

    def objective(self, b: int, actions: Array) -> tuple[float, float]:
        """Change of the running cost and value of the KL term under du = actions [T, nu], by model rollout."""
        dx, change, kl = np.zeros(NX), 0.0, 0.0
        for t in range(T):
            m = self.index[b, t]
            gap = self.deviation[b, t] + actions[t] - self.models.P[m] @ dx
            kl += C / 2 * gap @ (gap / self.models.variance[m])
            dx = self.models.F[m] @ np.concatenate([dx, actions[t]])
            change += (np.square(self.residual[b, t] + self.root @ dx) - np.square(self.residual[b, t])).sum() / 2
        return change, kl

    def closed_loop(self, b: int, improved: Improvement) -> Array:
        """Actions of the improved policy from the recorded first state on [T, nu]."""
        dx, actions = np.zeros(NX), []
        for t in range(T):
            actions.append(improved.k[b, t] + improved.K[b, t] @ dx)
            dx = self.models.F[self.index[b, t]] @ np.concatenate([dx, actions[t]])
        return np.array(actions)


def problem(seed: int = 0, deviation: float = 0.1, policy: float = 0.3) -> Problem:
    rng = np.random.default_rng(seed)
    n = B * T
    F = rng.normal(0, 0.4, (n, NX, NX + NU))
    P, variance = rng.normal(0, policy, (n, NU, NX)), rng.uniform(0.01, 0.05, (n, NU))
    models = Models(F, np.zeros((n, NX)), P, np.zeros((n, NU)), variance)
    state, target = rng.normal(0, 1, (B, T, NX)), rng.normal(size=(B, T, 2))
    target /= np.linalg.norm(target, axis=2, keepdims=True)
    return Problem(
        models,
        rng.permutation(n).reshape(B, T),
        cost.residual(state, target, 0.8, 0.1),
        cost.root(NX, 0.1),
        rng.normal(0, deviation, (B, T, NU)),
    )


def test_gains_equal_those_of_the_finite_horizon_riccati_equation() -> None:
    """Without a policy slope and deviation the KL term is an action cost R = c S^-1."""
    case = problem(deviation=0.0, policy=0.0)
    improved = case.solve()
    for b in range(B):
        H = case.root.T @ case.root
        M = H
        for t in reversed(range(T)):
            m = case.index[b, t]
            A, D = case.models.F[m][:, :NX], case.models.F[m][:, NX:]
            R = np.diag(C / case.models.variance[m])
            gain = np.linalg.inv(R + D.T @ M @ D) @ (D.T @ M @ A)
            np.testing.assert_allclose(improved.K[b, t], -gain, rtol=1e-3, atol=1e-4)
            M = H + A.T @ M @ A - A.T @ M @ D @ gain


def test_the_improved_policy_is_stationary_for_cost_and_kl_together() -> None:
    case = problem()
    improved = case.solve()
    for b in range(B):
        actions = case.closed_loop(b, improved)
        size = abs(sum(case.objective(b, np.zeros((T, NU)))))
        for t, j in np.ndindex(T, NU):
            step = np.zeros((T, NU))
            step[t, j] = 1e-3
            slope = (sum(case.objective(b, actions + step)) - sum(case.objective(b, actions - step))) / 2e-3
            assert abs(slope) < 2e-3 * size


def test_every_other_choice_of_actions_is_worse() -> None:
    case, rng = problem(), np.random.default_rng(1)
    improved = case.solve()
    for b in range(B):
        actions = case.closed_loop(b, improved)
        best = sum(case.objective(b, actions))
        for _ in range(20):
            assert sum(case.objective(b, actions + 0.05 * rng.normal(size=(T, NU)))) > best


def test_improved_actions_lower_the_predicted_cost_of_noise_free_trajectories() -> None:
    case = problem(deviation=0.0)
    improved = case.solve()
    assert (improved.predicted_cost_change.sum(axis=1) < 0).all()
    for b in range(B):
        change, _ = case.objective(b, case.closed_loop(b, improved))
        assert change == pytest.approx(improved.predicted_cost_change[b].sum(), rel=1e-3)


def test_the_predicted_change_is_that_of_the_model_rollout_with_noise_too() -> None:
    case = problem(deviation=0.2)
    improved = case.solve()
    for b in range(B):
        change, _ = case.objective(b, case.closed_loop(b, improved))
        assert change == pytest.approx(improved.predicted_cost_change[b].sum(), rel=1e-3, abs=1e-4)


def test_what_actions_from_elsewhere_are_promised_is_the_model_rollout_too() -> None:
    case = problem()
    actions = np.random.default_rng(1).normal(0, 0.2, (B, T, NU))
    promised = predicted_change(case.models.F, case.index, case.residual, case.root, actions)
    for b in range(B):
        assert promised[b].sum() == pytest.approx(case.objective(b, actions[b])[0], rel=1e-4)


def test_a_heavy_kl_term_returns_the_policy_mean() -> None:
    case = problem()
    models = prepare(case.models, 1e4)
    improved = backward_pass(models, case.index, case.residual, case.root, case.deviation)
    np.testing.assert_allclose(improved.k, -case.deviation, atol=1e-3)


def test_sub_trajectories_do_not_influence_each_other() -> None:
    case = problem()
    together = case.solve()
    for b in range(B):
        only = slice(b, b + 1)
        alone = backward_pass(
            prepare(case.models, C), case.index[only], case.residual[only], case.root, case.deviation[only]
        )
        np.testing.assert_allclose(alone.k, together.k[only], rtol=1e-5)


def test_a_given_variance_replaces_the_fitted_one_and_has_a_floor() -> None:
    models = problem().models
    np.testing.assert_allclose(prepare(models, C, 0.04).R_inverse, 0.04 / C)
    np.testing.assert_allclose(prepare(models, C, 0.0).R_inverse, 1e-4 / C)


@pytest.mark.parametrize("variance", [0.02, 0.0])
@pytest.mark.parametrize(("length", "radius"), [(1, 0.8), (10, 0.8), (40, 0.8), (40, 0.1)])
@pytest.mark.parametrize(("nx", "nu"), [(3, 24), (39, 24), (75, 24), (16, 8), (7, 33), (6, 1)])
def test_a_plain_loop_in_double_precision_gives_the_same_to_four_digits(
    nx: int, nu: int, length: int, radius: float, variance: float
) -> None:
    """At sizes of the robot and others; beyond nx / 3 steps, also where all is soon forgotten; without noise, too."""
    b = 20
    rng = np.random.default_rng(0)
    F = rng.normal(0, radius / np.sqrt(nx), (b, nx, nx + nu))  # spectral radius
    F[:, -1:] = -F[:, -2:-1]  # dependent rows, as of nodes about the centre of mass
    P = rng.normal(0, 0.1, (b, nu, nx))
    models = Models(F, np.zeros((b, nx)), P, np.zeros((b, nu)), np.full((b, nu), 0.02))
    model = rng.integers(0, b, (b, length))
    target = rng.normal(size=(b, length, 2))
    target /= np.linalg.norm(target, axis=2, keepdims=True)
    residual = cost.residual(rng.normal(0, 0.5, (b, length, nx)), target, 0.8, 0.1)
    root, deviation = cost.root(nx, 0.1), rng.normal(0, np.sqrt(variance), (b, length, nu))
    improved = backward_pass(prepare(models, 0.02, variance), model, residual, root, deviation)
    for place in range(b):
        around = residual[place] @ root, root.T @ root, deviation[place]
        K, k, change = plain_backward_pass(F[model[place]], P[model[place]], variance, 0.02, *around)
        assert np.abs(improved.K[place] - K).max() < 1e-4 * np.abs(K).max()
        assert np.abs(improved.k[place] - k).max() < 1e-4 * np.abs(k).max()
        assert improved.predicted_cost_change[place].sum() == pytest.approx(change, rel=1e-3)


def test_models_that_are_not_finite_are_refused() -> None:
    case = problem()
    case.models.F[case.index[1, 2], 0, 0] = np.nan
    with pytest.raises(DataError, match=r"sub-trajectory 1 of 4: its models are not finite.*kl_weight"):
        case.solve()


@pytest.mark.parametrize("changed", ["index beyond the table", "deviation of another length"])
def test_arrays_that_do_not_fit_together_are_refused(changed: str) -> None:
    case = problem()
    if changed == "index beyond the table":
        case.index[0, 0] = len(case.models.F)
    else:
        case.deviation = case.deviation[:, :-1]
    with pytest.raises(ValueError, match="other types or shapes"):
        case.solve()
