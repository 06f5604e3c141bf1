"""Laws of the running cost."""

from __future__ import annotations

import numpy as np

from t6gps.learner import cost


def test_the_cost_is_zero_exactly_at_the_target_velocity() -> None:
    state, target = np.array([[0.48, 0.64, 0.0, 5.0]]), np.array([[0.6, 0.8]])
    assert cost.running_cost(state, target, 0.8, 0.1)[0] < 1e-30
    assert cost.running_cost(state + [[0, 0, 0.5, 0]], target, 0.8, 0.1)[0] > 0


def test_standing_still_costs_the_squared_target_speed() -> None:
    np.testing.assert_allclose(cost.running_cost(np.zeros((1, 3)), np.array([[0.6, 0.8]]), 0.8, 0.1), 0.64)


def test_residual_and_root_give_gradient_and_hessian_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    state, target = rng.normal(size=5), np.array([0.6, -0.8])

    def at(x: np.ndarray) -> float:
        return float(cost.running_cost(x, target, 0.8, 0.1))

    steps = 1e-4 * np.eye(5)
    numeric = [(at(state + e) - at(state - e)) / 2e-4 for e in steps]
    root = cost.root(5, 0.1)
    np.testing.assert_allclose(cost.residual(state, target, 0.8, 0.1) @ root, numeric, atol=1e-9)
    second = [
        [(at(state + a + b) - at(state + a - b) - at(state - a + b) + at(state - a - b)) / 4e-8 for a in steps]
        for b in steps
    ]
    np.testing.assert_allclose(root.T @ root, second, atol=1e-6)
