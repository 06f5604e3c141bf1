"""Laws of winches and attachments: load slows a winch, a dead one never moves, cables pull where they attach."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.cables import loads, move_winches, tensions
from t6gps.workers.physics.mujoco_engine import MujocoEngine
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings

HARDWARE = RobotSettings(
    attachment_span_m=1.65,
    cable_stiffness_n_per_m=4000.0,
    cable_max_tension_n=400.0,
    winch_speed_m_per_s=0.078,
    winch_stall_n=1000.0,
)
COMMANDS = np.random.default_rng(0).uniform(0.5, 1.5, (10, CABLES_N))


@pytest.mark.parametrize("change", [{}, {"dead_winch": 5}], ids=["all winches", "one dead"])
def test_the_plugin_equals_the_reference_to_the_last_bit(change: dict[str, object]) -> None:
    robot, ends = HARDWARE.model_copy(update=change), []
    for stepper in ("plugin", "reference"):
        with PyBulletEngine(robot, stepper) as engine:
            engine.reset(neutral_state(robot, 1.0))
            ends.append([engine.control_step(command) for command in COMMANDS][-1])
    assert np.array_equal(ends[0].bars, ends[1].bars)
    assert np.array_equal(ends[0].rest_lengths, ends[1].rest_lengths)


def test_both_engines_have_the_same_winches_and_attachments() -> None:
    robot, ends = HARDWARE.model_copy(update={"dead_winch": 5}), []
    for engine_of in (PyBulletEngine, MujocoEngine):
        with engine_of(robot) as engine:
            engine.reset(neutral_state(robot, 50.0))
            ends.append([engine.control_step(command) for command in COMMANDS][-1])
    np.testing.assert_allclose(ends[1].nodes(), ends[0].nodes(), atol=1e-10)
    np.testing.assert_allclose(ends[1].rest_lengths, ends[0].rest_lengths, atol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.9, 1.0, 1.5])
def test_a_winch_hauls_slower_by_the_share_of_its_stall_tension_and_pays_out_at_full_speed(share: float) -> None:
    state = neutral_state(HARDWARE)
    lengths = state.rest_lengths + (HARDWARE.pretension_n - 400.0 * share) / HARDWARE.cable_stiffness_n_per_m
    state = state.but(rest_lengths=lengths)
    robot = HARDWARE.model_copy(update={"winch_stall_n": 400.0, "cable_max_tension_n": 1000.0})
    step = robot.winch_speed_m_per_s * robot.physics_step_s
    np.testing.assert_allclose(tensions(state, robot)[0], 400.0 * share, atol=1e-9)
    hauled = move_winches(state, np.full(CABLES_N, 0.1), robot).rest_lengths
    np.testing.assert_allclose(lengths - hauled, step * max(0.0, 1 - share), atol=1e-12)
    np.testing.assert_allclose(move_winches(state, np.full(CABLES_N, 1.5), robot).rest_lengths - lengths, step)


def test_without_a_stall_tension_load_does_not_slow_a_winch() -> None:
    robot = HARDWARE.model_copy(update={"winch_stall_n": None})
    state = neutral_state(robot)
    hauled = move_winches(state, np.full(CABLES_N, 0.1), robot).rest_lengths
    np.testing.assert_allclose(state.rest_lengths - hauled, robot.winch_speed_m_per_s * robot.physics_step_s)


def test_a_dead_winch_stays_where_it_is_and_the_others_move() -> None:
    robot = HARDWARE.model_copy(update={"dead_winch": 7})
    with PyBulletEngine(robot) as engine:
        before = neutral_state(robot, 50.0)
        engine.reset(before)
        moved = engine.control_step(np.full(CABLES_N, 1.5)).rest_lengths != before.rest_lengths
    assert np.flatnonzero(~moved).tolist() == [7]


@pytest.mark.parametrize("span_m", [1.94, 1.65, 1.3])
def test_the_neutral_shape_is_in_equilibrium_wherever_cables_attach(span_m: float) -> None:
    robot = RobotSettings(attachment_span_m=span_m)
    state = neutral_state(robot)
    tension, _ = tensions(state, robot)
    np.testing.assert_allclose(tension, robot.pretension_n, rtol=1e-9)
    for load in loads(state, robot):
        np.testing.assert_allclose(load, 0.0, atol=1e-9)
    assert nominal_rest_length(robot) == pytest.approx(np.sqrt(3 / 8) * span_m - 0.1)
