"""Laws of the robot's physics."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from t6gps.storage.errors import PhysicsError
from t6gps.workers.episode.start import turn
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.bullet_hooks import plugin
from t6gps.workers.physics.engine import CONTROL_STEP_S, GRAVITY_M_PER_S2
from t6gps.workers.robot import symmetry
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import (
    BAR_LENGTH_M,
    CABLES_N,
    DELTA,
    FACE_KINDS,
    FACES,
    NODES_M,
)
from t6gps.workers.settings import RobotSettings

ROBOT = RobotSettings()
ROUGH = generate(1, 1.0)


def _numbers(state: RobotState) -> Array:
    return np.concatenate([part.ravel() for part in vars(state).values()])


def _commands(steps: int, seed: int = 0) -> Array:
    low, high = ROBOT.shortest_command_m, ROBOT.longest_command_m
    return np.random.default_rng(seed).uniform(low, high, (steps, CABLES_N))


def _run(engine: PyBulletEngine, start: RobotState, commands: Array) -> list[RobotState]:
    engine.reset(start)
    return [engine.control_step(command) for command in commands]


def _start(ground: Terrain | None) -> RobotState:
    return neutral_state(ROBOT, 1.07 if ground is None else 1.6)


def _on_a_delta() -> RobotState:
    """The neutral shape just above the plane, a closed triangle down."""
    down = NODES_M[FACES[FACE_KINDS == DELTA][0]].mean(axis=0)
    down /= np.linalg.norm(down)
    half_way = np.append(np.cross(down, [0.0, 0.0, -1.0]), 1 - down[2])
    turned = turn(neutral_state(ROBOT), half_way / np.linalg.norm(half_way))
    lift = [0.0, 0.0, ROBOT.bar_radius_m - turned.nodes()[:, 2].min()]
    return turned.but(bar_positions=turned.bar_positions + lift)


def _stirred(state: RobotState, seed: int) -> RobotState:
    """The state with random velocities and rest lengths."""
    rng = np.random.default_rng(seed)
    return state.but(
        bar_velocities=state.bar_velocities + rng.normal(0.0, 0.3, (6, 3)),
        bar_angular_velocities=rng.normal(0.0, 1.0, (6, 3)),
        rest_lengths=state.rest_lengths + rng.uniform(-0.1, 0.1, CABLES_N),
    )


# Plugin and reference


@pytest.mark.parametrize(("ground", "steps"), [(None, 100), (ROUGH, 100)], ids=["flat", "rough"])
def test_plugin_equals_reference_to_the_last_bit(ground: Terrain | None, steps: int) -> None:
    commands = _commands(steps)
    trajectories = []
    for stepper in ("plugin", "reference"):
        with PyBulletEngine(ROBOT, stepper) as engine:
            engine.set_ground(ground)
            trajectories.append(_run(engine, _start(ground), commands))
    for fast, plain in zip(*trajectories, strict=True):
        np.testing.assert_array_equal(_numbers(fast), _numbers(plain))


def test_several_simulations_in_one_process_do_not_disturb_each_other() -> None:
    commands = _commands(10)
    with PyBulletEngine(ROBOT) as alone:
        expected = _run(alone, _start(None), commands)
    with PyBulletEngine(ROBOT) as first, PyBulletEngine(ROBOT.model_copy(update={"bar_mass_kg": 4.0})) as second:
        first.reset(_start(None))
        second.reset(_start(None))
        for command, state in zip(commands, expected, strict=True):
            second.control_step(command)
            np.testing.assert_array_equal(_numbers(first.control_step(command)), _numbers(state))


# Motion


def _image(state: RobotState, element: int, yaw: float) -> RobotState:
    """The state under H_g: labels permuted, the world turned and, for improper elements, mirrored."""
    world = symmetry.world_map(element, yaw)
    bars = symmetry.BARS_FROM[element]
    nodes = (state.nodes() @ world.T)[symmetry.NODES_FROM[element]]
    axes = (nodes[0::2] - nodes[1::2]) / BAR_LENGTH_M
    # Any turn that carries z to the axis will do, for bars are round; the tests avoid the axis -z.
    quaternions = np.stack([-axes[:, 1], axes[:, 0], np.zeros(6), 1 + axes[:, 2]], axis=1)
    return RobotState.of(
        (state.bar_positions @ world.T)[bars],
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        (state.bar_velocities @ world.T)[bars],
        np.linalg.det(world) * (state.bar_angular_velocities @ world.T)[bars],
        state.rest_lengths[symmetry.CABLES_FROM[element]],
    )


@pytest.fixture(scope="module")
def flat() -> PyBulletEngine:
    return PyBulletEngine(ROBOT)


@pytest.mark.parametrize("element", range(24))
@pytest.mark.parametrize(("height_m", "tolerance_m"), [(50.0, 1e-9), (1.07, 0.02)], ids=["in flight", "on the ground"])
def test_dynamics_commute_with_every_symmetry(
    flat: PyBulletEngine, element: int, height_m: float, tolerance_m: float
) -> None:
    """Over 0.5 s; exact in flight. On the ground Bullet solves contacts in turns, which is no symmetric thing to do:
    nodes that moved some 0.5 m may then differ by up to 2 cm (docs/physics.md)."""
    tilt = np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)
    start = _stirred(turn(neutral_state(ROBOT, height_m), tilt), element)
    commands = _commands(5, element)
    yaw = 0.7
    there = _image(_run(flat, start, commands)[-1], element, yaw)
    images = commands[:, symmetry.CABLES_FROM[element]]
    here = _run(flat, _image(start, element, yaw), images)[-1]
    np.testing.assert_allclose(here.nodes(), there.nodes(), atol=tolerance_m)
    np.testing.assert_allclose(here.rest_lengths, there.rest_lengths, atol=1e-12)


def test_free_flight_keeps_momentum(flat: PyBulletEngine) -> None:
    start = _stirred(neutral_state(ROBOT, 50.0), 1)
    seconds = 10 * CONTROL_STEP_S
    end = _run(flat, start, _commands(10))[-1]
    fall = np.array([0.0, 0.0, -GRAVITY_M_PER_S2 * seconds])
    np.testing.assert_allclose(end.com_velocity, start.com_velocity + fall, atol=1e-9)


def _angular_momentum(state: RobotState, robot: RobotSettings) -> Array:
    nodes = state.nodes()
    axes = (nodes[0::2] - nodes[1::2]) / BAR_LENGTH_M
    spin = (state.bar_angular_velocities * axes).sum(axis=1, keepdims=True) * axes
    transverse = robot.bar_mass_kg * BAR_LENGTH_M**2 / 12
    spins = transverse * (state.bar_angular_velocities - spin) + robot.axial_inertia_kg_m2 * spin
    orbit = np.cross(state.bar_positions - state.com, state.bar_velocities - state.com_velocity)
    return np.asarray((spins + robot.bar_mass_kg * orbit).sum(axis=0))


def test_free_flight_keeps_angular_momentum() -> None:
    robot = ROBOT.model_copy(update={"axial_damping_n_m_s": 0.0})
    start = _stirred(neutral_state(robot, 50.0), 1)
    before = _angular_momentum(start, robot)
    with PyBulletEngine(robot) as engine:
        end = _run(engine, start, _commands(10))[-1]
    assert np.linalg.norm(_angular_momentum(end, robot) - before) < 0.02 * np.linalg.norm(before)


def test_a_standing_robot_at_rest_stays_at_rest(flat: PyBulletEngine) -> None:
    hold = np.full((120, CABLES_N), nominal_rest_length(ROBOT))
    settled = _run(flat, _on_a_delta(), hold)[-1]
    later = _run(flat, settled, hold[:30])
    assert max(np.abs(state.node_velocities()).max() for state in later) < 2e-3
    assert max(np.abs(state.nodes() - settled.nodes()).max() for state in later) < 1e-3
    assert settled.com[2] == pytest.approx(0.84 + ROBOT.bar_radius_m, abs=0.07)


def test_a_flat_mesh_carries_like_the_plane(flat: PyBulletEngine) -> None:
    hold = np.full((120, CABLES_N), nominal_rest_length(ROBOT))
    on_plane = _run(flat, _on_a_delta(), hold)[-1]
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(generate(0, 0.0))
        on_mesh = _run(engine, _on_a_delta(), hold)[-1]
    np.testing.assert_allclose(on_mesh.nodes(), on_plane.nodes(), atol=0.01)


@pytest.mark.slow
def test_no_bar_sinks_into_or_passes_through_the_roughest_ground() -> None:
    """In 40 episodes of 10 s under fast random winches, every point of an axis keeps 0.8 radii above the triangles."""
    robot = ROBOT.model_copy(update={"winch_speed_m_per_s": 0.7})
    shares = np.linspace(0.0, 1.0, 21)[:, None, None]
    lowest = []
    with PyBulletEngine(robot) as engine:
        for seed in range(40):
            ground = generate(seed, 1.0)
            engine.set_ground(ground)
            states = _run(engine, neutral_state(robot, 1.9), _commands(100, seed))
            nodes = np.array([state.nodes() for state in states])
            axes = shares * nodes[:, None, 0::2] + (1 - shares) * nodes[:, None, 1::2]
            lowest.append((axes[..., 2] - ground.height(axes[..., 0], axes[..., 1])).min())
    assert min(lowest) > 0.8 * robot.bar_radius_m


def test_winches_move_at_their_speed_and_stop_at_the_clipped_command(flat: PyBulletEngine) -> None:
    flat.reset(neutral_state(ROBOT, 50.0))
    command = np.full(CABLES_N, 9.0)
    nominal, reach = nominal_rest_length(ROBOT), ROBOT.winch_speed_m_per_s * CONTROL_STEP_S
    np.testing.assert_allclose(flat.control_step(command).rest_lengths, nominal + reach, atol=1e-12)
    for _ in range(15):
        state = flat.control_step(command)
    np.testing.assert_allclose(state.rest_lengths, ROBOT.longest_command_m)


def test_the_usual_physics_step_is_close_to_a_fine_one() -> None:
    ends = []
    for step_s in (ROBOT.physics_step_s, 0.0005):
        with PyBulletEngine(ROBOT.model_copy(update={"physics_step_s": step_s})) as engine:
            ends.append(_run(engine, _on_a_delta(), _commands(10))[-1].com)
    assert np.linalg.norm(ends[0] - ends[1]) < 0.03


# Repeatability


def _digest(ground: Terrain | None, engine: PyBulletEngine) -> str:
    states = _run(engine, _start(ground), _commands(30, 7))
    return hashlib.sha256(np.array([_numbers(state) for state in states]).tobytes()).hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("ground", [None, ROUGH], ids=["flat", "rough"])
def test_an_episode_repeats_to_the_last_bit_in_a_fresh_process_and_a_used_client(ground: Terrain | None) -> None:
    fresh = subprocess.run(
        [sys.executable, __file__, "flat" if ground is None else "rough"],
        capture_output=True,
        text=True,
        check=True,
    )
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(generate(8, 0.5))
        _run(engine, _start(ROUGH), _commands(20, 1))
        engine.set_ground(ground)
        _run(engine, _start(ground), _commands(20, 2))
        used = _digest(ground, engine)
    assert fresh.stdout.split()[-1] == used


@pytest.mark.parametrize("ground", [None, ROUGH], ids=["flat", "rough"])
def test_a_reset_forgets_the_contacts_of_the_past(ground: Terrain | None) -> None:
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(ground)
        lying = _run(engine, _start(ground), _commands(20, 2))[-1]
        first = _run(engine, lying, _commands(5, 3))[-1]
        _run(engine, lying, _commands(1, 4))
        again = _run(engine, lying, _commands(5, 3))[-1]
    np.testing.assert_array_equal(_numbers(first), _numbers(again))


def test_changing_the_ground_does_not_gather_memory() -> None:
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(ROUGH)
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            for seed in range(5):
                engine.set_ground(generate(seed, 1.0))
            after, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert after - before < 2e6


# Refusals


def test_a_physics_step_that_does_not_divide_the_control_step_is_refused() -> None:
    with pytest.raises(PhysicsError, match=r"must divide the control step.*choose"):
        PyBulletEngine(ROBOT.model_copy(update={"physics_step_s": 0.003}))


def test_an_unknown_stepper_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("T6GPS_PHYSICS", "magic")
    with pytest.raises(PhysicsError, match="one of plugin, reference, bullet, got 'magic'"):
        PyBulletEngine(ROBOT)


def test_a_missing_plugin_is_named_with_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(PhysicsError, match=r"_stepper\..*so is not built.*T6GPS_PHYSICS=reference"):
        plugin.library_path(tmp_path)


def test_a_library_without_bullets_functions_is_refused_with_their_name() -> None:
    refusal = pytest.raises(PhysicsError, match="lacks the function b3InitStepSimulationCommand")
    with PyBulletEngine(ROBOT, "reference") as engine, refusal:
        plugin.PluginStepper(engine.client, ROBOT, 25, bullet_library=str(plugin.library_path()))


@pytest.mark.parametrize("command", [np.full(CABLES_N, np.nan), np.ones(23)], ids=["not finite", "wrong length"])
def test_a_malformed_command_is_refused(flat: PyBulletEngine, command: Array) -> None:
    with pytest.raises(PhysicsError, match="24 finite rest lengths"):
        flat.control_step(command)


def test_a_robot_below_the_ground_is_refused() -> None:
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(ROUGH)
        engine.reset(neutral_state(ROBOT, -10.0))
        with pytest.raises(PhysicsError, match="below the ground"):
            engine.control_step(np.full(CABLES_N, 1.0))


def test_an_unstable_simulation_is_refused(flat: PyBulletEngine) -> None:
    start = neutral_state(ROBOT, 50.0)
    flat.reset(start.but(bar_velocities=start.bar_velocities + 80.0))
    with pytest.raises(PhysicsError, match="became unstable"):
        flat.control_step(np.full(CABLES_N, 1.0))


def test_a_robot_beyond_the_side_of_the_ground_is_refused() -> None:
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(generate(0, 0.5, 10.0))
        start = neutral_state(ROBOT, 1.6)
        engine.reset(start.but(bar_positions=start.bar_positions + [4.8, 0.0, 0.0]))
        with pytest.raises(PhysicsError, match="beyond the ground's side at 5"):
            engine.control_step(np.full(CABLES_N, 1.0))


if __name__ == "__main__":
    chosen = {"flat": None, "rough": ROUGH}[sys.argv[1]]
    with PyBulletEngine(ROBOT) as fresh_engine:
        fresh_engine.set_ground(chosen)
        print(_digest(chosen, fresh_engine))


def test_a_robot_on_rough_ground_comes_back_from_branches_with_its_contacts() -> None:
    way, other = _commands(30), _commands(10, seed=1)
    with PyBulletEngine(ROBOT) as engine, PyBulletEngine(ROBOT) as undisturbed:
        for each in (engine, undisturbed):
            each.set_ground(ROUGH)
            each.reset(neutral_state(ROBOT).but(bar_positions=neutral_state(ROBOT).bar_positions + [0, 0, 1.5]))
        for number, command in enumerate(way):
            if number % 10 == 5:
                with engine.branching() as back:
                    ends = [[engine.control_step(each) for each in other] for _ in range(2) if back() is None]
                assert np.array_equal(_numbers(ends[0][-1]), _numbers(ends[1][-1]))
            assert np.array_equal(_numbers(engine.control_step(command)), _numbers(undisturbed.control_step(command)))
