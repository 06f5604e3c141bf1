"""Laws of mechanics that the whole simulation keeps, contacts included."""

import numpy as np
import pytest

from t6gps.workers.bench.soundness import EXTREME_ROBOTS, extremes
from t6gps.workers.episode.start import random_start, turn
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import GRAVITY_M_PER_S2
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, CABLES, CABLES_N
from t6gps.workers.settings import RobotSettings

ROBOT = RobotSettings()
ROUGH = generate(3, 1.0)
GROUND_BODY = 0


def mechanical_energy(state: RobotState) -> float:
    """Kinetic, gravitational and elastic energy (J)."""
    axes = state.arms() / (BAR_LENGTH_M / 2)
    omega = state.bar_angular_velocities
    axial = (omega * axes).sum(axis=1)
    transverse_squared = (omega**2).sum(axis=1) - axial**2
    transverse_inertia = ROBOT.bar_mass_kg * BAR_LENGTH_M**2 / 12
    kinetic = 0.5 * ROBOT.bar_mass_kg * (state.bar_velocities**2).sum() + 0.5 * (
        transverse_inertia * transverse_squared.sum() + ROBOT.axial_inertia_kg_m2 * (axial**2).sum()
    )
    nodes = state.nodes()
    lengths = np.linalg.norm(nodes[CABLES[:, 1]] - nodes[CABLES[:, 0]], axis=1)
    stretch = np.maximum(0, lengths - state.rest_lengths)
    elastic = 0.5 * ROBOT.cable_stiffness_n_per_m * (stretch**2).sum()
    return float(kinetic + elastic + ROBOT.bar_mass_kg * GRAVITY_M_PER_S2 * state.bar_positions[:, 2].sum())


def thrown(rng: np.random.Generator, height_m: float) -> RobotState:
    """A robot in a random orientation and shape, thrown sideways."""
    quaternion = rng.standard_normal(4)
    state = turn(neutral_state(ROBOT, height_m), quaternion / np.linalg.norm(quaternion))
    return state.but(
        rest_lengths=state.rest_lengths + rng.uniform(-0.15, 0.15, CABLES_N),
        bar_velocities=state.bar_velocities + 1.5 * rng.standard_normal(3),
    )


@pytest.mark.parametrize(("ground", "height_m"), [(None, 2.0), (ROUGH, 2.6)], ids=["flat", "rough"])
def test_with_still_winches_mechanical_energy_never_rises(ground: Terrain | None, height_m: float) -> None:
    """By more than 20 mJ in 0.1 s, of some 1,000 J: the largest rise measured over 20 throws is 1 mJ."""
    with PyBulletEngine(ROBOT) as engine:
        engine.set_ground(ground)
        for seed in range(6):
            state = thrown(np.random.default_rng(seed), height_m)
            engine.reset(state)
            energies = [mechanical_energy(state)]
            for _ in range(60):
                energies.append(mechanical_energy(engine.control_step(state.rest_lengths)))
            assert np.diff(energies).max() < 0.02
            assert energies[-1] < energies[0] - 100


@pytest.mark.parametrize("ground", [None, ROUGH], ids=["flat", "rough"])
@pytest.mark.parametrize("friction", [0.5, 1.0])
def test_contacts_stay_inside_the_friction_cone_and_sliding_ones_reach_it(
    ground: Terrain | None, friction: float
) -> None:
    robot = RobotSettings(friction=friction)
    rng = np.random.default_rng(0)
    shares = []
    with PyBulletEngine(robot) as engine:
        engine.set_ground(ground)
        random_start(engine, robot, ground, rng)
        for _ in range(60):
            engine.control_step(rng.uniform(robot.shortest_command_m, robot.longest_command_m, CABLES_N))
            for bar in engine.bodies:
                for contact in pybullet.getContactPoints(bar, GROUND_BODY, physicsClientId=engine.client):
                    normal_n, first_n, second_n = contact[9], contact[10], contact[12]
                    assert normal_n >= 0
                    if normal_n > 1:
                        shares.append(np.hypot(first_n, second_n) / (friction * normal_n))
    assert len(shares) > 50
    assert max(shares) == pytest.approx(1.0, abs=1e-9)


def track(start: RobotState, commands: Array, physics_step_s: float) -> Array:
    robot = RobotSettings(physics_step_s=physics_step_s)
    with PyBulletEngine(robot) as engine:
        engine.reset(start)
        return np.array([engine.control_step(command).com for command in commands])


def test_halving_the_physics_step_changes_tracks_little() -> None:
    """CoM over 2 s of random commands from 12 starts on the plane: see docs/physics.md for the measured figures."""
    gaps = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        with PyBulletEngine(ROBOT) as engine:
            start = random_start(engine, ROBOT, None, rng)
        commands = rng.uniform(ROBOT.shortest_command_m, ROBOT.longest_command_m, (20, CABLES_N))
        usual, half = (track(start, commands, step_s) for step_s in (0.004, 0.002))
        gaps.append(np.linalg.norm(usual - half, axis=1).max())
    assert np.median(gaps) < 0.02
    assert max(gaps) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("robot", EXTREME_ROBOTS)
def test_the_widest_commands_on_the_roughest_ground_stay_sound(robot: RobotSettings) -> None:
    """`t6gps bench soundness` measures the same over 500 episodes."""
    figures = extremes(robot, range(4))
    assert figures["unsound_episodes"] == 0
    assert figures["lowest_node_m"] > -0.3
    assert figures["fastest_com_m_per_s"] < 8
    assert figures["fastest_spin_rad_per_s"] < 100
    assert figures["longest_cable_m"] < BAR_LENGTH_M + 0.1
