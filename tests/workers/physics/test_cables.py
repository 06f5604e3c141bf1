"""Laws of the cables: they pull, never push, and hold the neutral shape in equilibrium."""

from __future__ import annotations

import numpy as np

from t6gps.workers.physics.cables import loads, tensions
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, CABLES, CABLES_N, NODES_M, NODES_N
from t6gps.workers.settings import RobotSettings

ROBOT = RobotSettings()


def _stirred(state: RobotState, seed: int) -> RobotState:
    """The state with random velocities and rest lengths."""
    rng = np.random.default_rng(seed)
    return state.but(
        bar_velocities=state.bar_velocities + rng.normal(0.0, 0.3, (6, 3)),
        bar_angular_velocities=rng.normal(0.0, 1.0, (6, 3)),
        rest_lengths=state.rest_lengths + rng.uniform(-0.1, 0.1, CABLES_N),
    )


def test_cables_never_push_and_keep_their_bounds() -> None:
    rng = np.random.default_rng(0)
    for seed in range(50):
        state = _stirred(neutral_state(ROBOT), seed)
        state = state.but(rest_lengths=rng.uniform(0.2, 1.4, CABLES_N))
        tension, _ = tensions(state, ROBOT)
        nodes = state.nodes()
        lengths = np.linalg.norm(nodes[CABLES[:, 1]] - nodes[CABLES[:, 0]], axis=1)
        elastic = ROBOT.cable_stiffness_n_per_m * np.maximum(0.0, lengths - state.rest_lengths)
        assert (tension >= 0.0).all()
        assert (tension <= np.minimum(2 * elastic, ROBOT.cable_max_tension_n) + 1e-9).all()
        assert (tension[lengths < state.rest_lengths] == 0.0).all()


def test_the_neutral_shape_is_in_equilibrium_with_bars_compressed_by_root_6_tensions() -> None:
    state = neutral_state(ROBOT)
    tension, pull = tensions(state, ROBOT)
    np.testing.assert_allclose(tension, ROBOT.pretension_n)
    forces, torques = loads(state, ROBOT)
    np.testing.assert_allclose(forces, 0.0, atol=1e-9)
    np.testing.assert_allclose(torques, 0.0, atol=1e-9)
    pulls = np.zeros((NODES_N, 3))
    np.add.at(pulls, CABLES[:, 0], pull)
    np.add.at(pulls, CABLES[:, 1], -pull)
    nodes = state.nodes()
    inward = (nodes[BARS[:, 1]] - nodes[BARS[:, 0]]) / BAR_LENGTH_M
    np.testing.assert_allclose((pulls[BARS[:, 0]] * inward).sum(axis=1), np.sqrt(6) * ROBOT.pretension_n, rtol=1e-12)


def test_loads_sum_to_no_force_and_no_torque_on_the_robot() -> None:
    robot = ROBOT.model_copy(update={"axial_damping_n_m_s": 0.0})
    state = _stirred(neutral_state(robot), 3)
    forces, torques = loads(state, robot)
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose((torques + np.cross(state.bar_positions, forces)).sum(axis=0), 0.0, atol=1e-9)


def test_neutral_state_has_the_nodes_of_the_topology() -> None:
    state = neutral_state(ROBOT, 2.0)
    np.testing.assert_allclose(state.nodes(), NODES_M + [0.0, 0.0, 2.0], atol=1e-12)
    assert (state.rest_lengths == nominal_rest_length(ROBOT)).all()
