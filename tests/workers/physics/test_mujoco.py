"""Two engines that share no code, PyBullet and MuJoCo, agree on what the robot does.

Tolerances are about twice what was measured (numbers in the docstrings; docs/physics.md has more of them).
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.storage.errors import PhysicsError
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.bench.mujoco import mujoco_speed
from t6gps.workers.episode.start import turn
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.cables import tensions
from t6gps.workers.physics.engine import Engine
from t6gps.workers.physics.mjcf import to_mjcf
from t6gps.workers.physics.mujoco_engine import MujocoEngine
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.support import support_face
from t6gps.workers.robot.topology import CABLES_N, FACES, FACES_N, NODES_M
from t6gps.workers.settings import RobotSettings, RolloutSettings
from t6gps.workers.worker import RolloutWorker

ROBOT = RobotSettings()
HOLD = np.full(CABLES_N, nominal_rest_length(ROBOT))
ROUGH = generate(1, 1.0)

Engines = tuple[Engine, Engine]


@pytest.fixture(scope="module")
def engines() -> Iterator[Engines]:
    """PyBullet and MuJoCo with the same robot on the plane."""
    with PyBulletEngine(ROBOT) as bullet, MujocoEngine(ROBOT) as second:
        yield bullet, second


def _motion(engine: Engine, start: RobotState, commands: Array) -> list[RobotState]:
    engine.reset(start)
    return [engine.state(), *(engine.control_step(command) for command in commands)]


def _lowest_at(state: RobotState, height_m: float) -> RobotState:
    """The state lifted so that its lowest node clears the plane by `height_m`."""
    lift = ROBOT.bar_radius_m + height_m - state.nodes()[:, 2].min()
    return state.but(bar_positions=state.bar_positions + [0.0, 0.0, lift])


def on_face(face: int) -> RobotState:
    """The neutral shape standing on a face."""
    a, b, c = NODES_M[FACES[face]]
    down = np.cross(b - a, c - a)
    down /= np.linalg.norm(down)
    half_way = np.append(np.cross(down, [0.0, 0.0, -1.0]), 1 - down[2])
    return _lowest_at(turn(neutral_state(ROBOT), half_way / np.linalg.norm(half_way)), 0.0)


def rolling(number: int, of: int) -> RobotState:
    """The neutral shape on a face, as a rigid body that rolls at 1.0 to 2.5 m/s; all starts of a set differ."""
    angle = 2 * np.pi * number / of
    state = turn(on_face(3 * number % FACES_N), np.array([0.0, 0.0, np.sin(angle), np.cos(angle)]))
    velocity = (1.0 + 1.5 * number / (of - 1)) * np.array([np.cos(3 * angle), np.sin(3 * angle), 0.0])
    turning = np.cross([0.0, 0.0, 1.0], velocity) / state.com[2]
    return state.but(
        bar_velocities=velocity + np.cross(turning, state.bar_positions - state.com),
        bar_angular_velocities=np.tile(turning, (6, 1)),
    )


def stance_difference(engines: Engines, face: int) -> tuple[float, float, bool]:
    """Difference of the CoM heights (m) and largest difference of a tension (N) at rest; whether both stay on it."""
    ends = [_motion(engine, on_face(face), np.tile(HOLD, (120, 1)))[-1] for engine in engines]
    heights, pulls = [end.com[2] for end in ends], [tensions(end, ROBOT)[0] for end in ends]
    stays = all(support_face(end.nodes(), end.com) == face for end in ends)
    return abs(heights[0] - heights[1]), float(np.abs(pulls[0] - pulls[1]).max()), stays


def falls(engines: Engines, seed: int) -> tuple[Array, Array]:
    """The robot dropped from 0.3 m, in a random orientation: CoM heights (m) for 1.5 s [2, 16] and after 8 s [2]."""
    quaternion = np.random.default_rng(seed).standard_normal(4)
    start = _lowest_at(turn(neutral_state(ROBOT), quaternion / np.linalg.norm(quaternion)), 0.3)
    both = [_motion(engine, start, np.tile(HOLD, (80, 1))) for engine in engines]
    heights = np.array([[state.com[2] for state in motion] for motion in both])
    return heights[:, :16], heights[:, -1]


def rolls(engines: Engines, start: RobotState) -> tuple[float, Array, Array]:
    """Of 4 s of passive rolling: largest distance of the CoMs (m) until the triangle first changes in either engine,
    distances rolled (m) [2] and numbers of changes [2]."""
    both = [_motion(engine, start, np.tile(HOLD, (40, 1))) for engine in engines]
    com = np.array([[state.com for state in motion] for motion in both])
    faces = np.array([[support_face(state.nodes(), state.com) for state in motion] for motion in both])
    changed = (faces != faces[:, :1]).any(axis=0)
    until = int(changed.argmax()) if changed.any() else len(changed)
    gap = np.linalg.norm(com[0] - com[1], axis=1)[:until].max()
    rolled = np.linalg.norm(com[:, -1, :2] - com[:, 0, :2], axis=1)
    return float(gap), rolled, (np.diff(faces, axis=1) != 0).sum(axis=1)


def rough_fall(engines: Engines, seed: int) -> float:
    """Distance of the CoMs (m) 1 s after a drop onto rough ground at a random place in a random orientation."""
    rng = np.random.default_rng(seed)
    quaternion = rng.standard_normal(4)
    state = turn(neutral_state(ROBOT), quaternion / np.linalg.norm(quaternion))
    state = state.but(bar_positions=state.bar_positions + [*rng.uniform(-6.0, 6.0, 2), 0.0])
    nodes = state.nodes()
    lift = (ROUGH.height(nodes[:, 0], nodes[:, 1]) - nodes[:, 2]).max() + 0.2
    start = state.but(bar_positions=state.bar_positions + [0.0, 0.0, lift])
    bullet, second = (_motion(engine, start, np.tile(HOLD, (10, 1)))[-1].com for engine in engines)
    return float(np.linalg.norm(bullet - second))


# Agreement of the engines


@pytest.mark.parametrize("seed", range(3))
def test_flight_with_slack_cables_agrees_to_rounding(engines: Engines, seed: int) -> None:
    """Measured over 1 s: 4e-14 m, while the bars do not touch each other. The model's own cables differ by 2 cm."""
    rng = np.random.default_rng(seed)
    start = neutral_state(ROBOT, 50.0).but(
        bar_velocities=rng.normal(0.0, 0.5, (6, 3)),
        bar_angular_velocities=rng.normal(0.0, 1.5, (6, 3)),
        rest_lengths=rng.uniform(0.9, 1.35, CABLES_N),
    )
    assert (tensions(start, ROBOT)[0] == 0.0).sum() >= 5
    commands = rng.uniform(ROBOT.shortest_command_m, ROBOT.longest_command_m, (10, CABLES_N))
    bullet, second = (_motion(engine, start, commands)[-1] for engine in engines)
    np.testing.assert_allclose(second.nodes(), bullet.nodes(), atol=1e-11)
    np.testing.assert_allclose(second.node_velocities(), bullet.node_velocities(), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faces", "height_m", "tension_n"),
    [(range(2), 1e-4, 0.1), (range(8, 11), 1e-3, 3.0)],
    ids=["Delta", "Lambda"],
)
def test_a_standing_robot_has_the_same_height_and_tensions(
    engines: Engines, faces: range, height_m: float, tension_n: float
) -> None:
    """Measured over all faces: 0.05 mm and 0.01 N on a Delta, 0.43 mm and 1.3 N on a Lambda.

    The feet of a Lambda are pushed outward, and MuJoCo's friction lets them creep a little.
    """
    for face in faces:
        height_gap_m, tension_gap_n, stays = stance_difference(engines, face)
        assert stays
        assert height_gap_m < height_m
        assert tension_gap_n < tension_n


@pytest.mark.slow
def test_dropped_robots_bounce_alike(engines: Engines) -> None:
    """Measured over 20 orientations: CoM heights within 1.3 mm for 0.3 s (the first contact is at 0.25 s), within
    16 mm for 1.5 s; lowest point of the bounce within 3.5 mm; height at rest within 3.8 mm."""
    for seed in range(5):
        heights, at_rest = falls(engines, seed)
        gap = np.abs(heights[0] - heights[1])
        assert gap[:3].max() < 1e-9
        assert gap[3] < 0.003
        assert gap.max() < 0.03
        assert abs(heights[0].min() - heights[1].min()) < 0.007
        assert abs(at_rest[0] - at_rest[1]) < 0.008


@pytest.mark.slow
def test_rolling_robots_change_triangles_alike(engines: Engines) -> None:
    """Measured over these ten starts: CoM gap until the first change of the triangle 0.4 mm (median), 2.6 mm (worst);
    distance rolled in 4 s, 1.1 m on average, within 8 mm (median), 18 cm (worst); equal numbers of changes.
    Over 40 starts: 0.5 mm, 25 mm; 1 cm, 45 cm; equal numbers in 34, none more than 2 apart."""
    gaps, rolled, changes = zip(*(rolls(engines, rolling(number, 10)) for number in range(10)), strict=True)
    assert np.median(gaps) < 0.001
    assert max(gaps) < 0.01
    difference = np.abs(np.diff(rolled, axis=1))
    assert np.median(difference) < 0.03
    assert difference.max() < 0.5
    assert np.abs(np.diff(changes, axis=1)).sum() <= 3
    assert np.sum(changes) > 20


def test_a_robot_falls_alike_on_rough_ground() -> None:
    """Measured over 40 falls: CoM gap after 1 s 1.8 cm (median), 6 cm (90 %), 22 cm (worst)."""
    with PyBulletEngine(ROBOT) as bullet, MujocoEngine(ROBOT) as second:
        bullet.set_ground(ROUGH)
        second.set_ground(ROUGH)
        gaps = [rough_fall((bullet, second), seed) for seed in range(6)]
    assert np.median(gaps) < 0.05
    assert max(gaps) < 0.3


# The second engine alone


def test_both_engines_stand_on_the_same_surface() -> None:
    """Measured: 5e-8 m, as MuJoCo keeps heights in single precision. So cells have the same diagonals."""
    terrain = generate(4, 1.0, 10.0)
    model = mujoco.MjModel.from_xml_string(to_mjcf(ROBOT, terrain))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground, bars = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8), -1
    model.geom_group[1:] = 1  # rays see group 0 alone
    for x, y in np.random.default_rng(0).uniform(-4.99, 4.99, (500, 2)):
        fall = mujoco.mj_ray(model, data, [x, y, 9.0], [0.0, 0.0, -1.0], ground, 1, bars, np.zeros(1, np.int32))
        assert 9.0 - fall == pytest.approx(float(terrain.height(x, y)), abs=1e-6)


@pytest.mark.parametrize("ground", [None, ROUGH], ids=["flat", "rough"])
def test_a_reset_forgets_the_past(ground: Terrain | None) -> None:
    commands = np.random.default_rng(0).uniform(0.65, 1.35, (20, CABLES_N))
    with MujocoEngine(ROBOT) as engine:
        engine.set_ground(ground)
        lying = _motion(engine, neutral_state(ROBOT, 1.6), commands)[-1]
        first = _motion(engine, lying, commands[:5])[-1]
        again = _motion(engine, lying, commands[:5])[-1]
    np.testing.assert_array_equal(first.nodes(), again.nodes())


def test_a_reset_gives_the_state_back() -> None:
    rng = np.random.default_rng(1)
    start = turn(on_face(3), np.array([0.5, 0.5, 0.5, 0.5])).but(bar_angular_velocities=rng.normal(size=(6, 3)))
    with MujocoEngine(ROBOT) as engine:
        engine.reset(start)
        for name, value in vars(engine.state()).items():
            np.testing.assert_allclose(value, getattr(start, name), atol=1e-12, err_msg=name)


def test_unsound_states_are_refused_as_in_the_first_engine() -> None:
    with MujocoEngine(ROBOT) as engine:
        engine.reset(neutral_state(ROBOT, 50.0).but(bar_velocities=np.full((6, 3), 80.0)))
        with pytest.raises(PhysicsError, match="became unstable"):
            engine.control_step(HOLD)
        engine.set_ground(generate(0, 0.5, 10.0))
        start = neutral_state(ROBOT, 1.6)
        engine.reset(start.but(bar_positions=start.bar_positions + [4.8, 0.0, 0.0]))
        with pytest.raises(PhysicsError, match="beyond the ground's side at 5"):
            engine.control_step(HOLD)
    with pytest.raises(PhysicsError, match=r"must divide the control step.*choose"):
        MujocoEngine(ROBOT.model_copy(update={"physics_step_s": 0.003}))


def test_without_mujoco_the_error_names_the_extra() -> None:
    code = "import sys; sys.modules['mujoco'] = None; import t6gps.workers.physics.mujoco_engine"
    failed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert failed.stderr.decode().splitlines()[-1].endswith("pip install 't6gps[mujoco]'")


def test_an_episode_runs_on_the_second_engine() -> None:
    settings, rng = RolloutSettings(), np.random.default_rng(0)
    layer = (rng.normal(0.0, 0.3, (CABLES_N, OBSERVATION_N)).astype(np.float32), np.zeros(CABLES_N, np.float32))
    snapshot = PolicySnapshot(0, (layer,), nominal_rest_length(ROBOT), 0.2)
    plan = EpisodePlan(0, 0, 0, 3, 20, 5, 0.5, 0.1, 0)
    worker = RolloutWorker(settings, MujocoEngine)
    first, again = worker.run(plan, snapshot), worker.run(plan, snapshot)
    worker.close()
    assert first.summary["ended_by"].to_pylist() == ["completed"]
    assert first.frames.equals(again.frames)


# The exported model


@pytest.mark.parametrize("terrain", [None, ROUGH], ids=["flat", "rough"])
def test_the_exported_model_stands_up_by_itself(terrain: Terrain | None, tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(to_mjcf(ROBOT, terrain))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3000)
    assert model.body_mass.sum() == pytest.approx(6 * ROBOT.bar_mass_kg)
    assert np.abs(data.qvel.reshape(6, 6)[:, :3]).max() < 0.05  # in a valley bars may slip and spin a little
    pulls = -data.actuator_force[:CABLES_N]
    assert pulls.mean() == pytest.approx(ROBOT.pretension_n, rel=0.25)
    assert np.ptp(pulls) > 10.0  # it carries its weight
    com = data.qpos.reshape(6, 7)[:, :3].mean(axis=0)
    ground = 0.0 if terrain is None else float(terrain.height(com[0], com[1]))
    assert 0.5 < com[2] - ground < 1.2


def test_the_controls_of_the_exported_model_are_changes_of_rest_lengths() -> None:
    """Taut cables pull as the plain law says."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(ROBOT))
    data = mujoco.MjData(model)
    state = neutral_state(ROBOT)
    offsets = np.random.default_rng(0).uniform(-0.2, 0.05, CABLES_N)
    data.ctrl[:CABLES_N] = offsets
    mujoco.mj_forward(model, data)
    wanted, _ = tensions(state.but(rest_lengths=state.rest_lengths + offsets), ROBOT)
    np.testing.assert_allclose(-data.actuator_force[:CABLES_N], wanted, rtol=1e-9)


def test_the_benchmark_compares_motions_that_agree() -> None:
    result = mujoco_speed(repeats=8)
    assert set(result) == {"flat_speedup_over_mujoco", "rough_speedup_over_mujoco"}
    assert min(result.values()) > 0.0


# Command line


def test_export_writes_the_chosen_robot_and_ground(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    t6gps("export", "mjcf", path, "--set", "robot.bar_mass_kg=5.0", "--set", "terrain.difficulty=0.5")
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.body_mass.sum() == pytest.approx(30.0)
    assert model.nhfield == 1
    assert (
        "allowed: keys that start with robot., terrain."
        in t6gps("export", "mjcf", path, "--set", "run.seed=3", code=2).stderr
    )
    assert "cannot write" in t6gps("export", "mjcf", tmp_path / "absent" / "robot.xml", code=2).stderr


def test_eval_runs_on_the_second_engine(tiny: Trained) -> None:
    arguments = ("eval", "tiny", "--episodes", "2", "--serial", "--no-keep", "--json", "--root", tiny.run.path.parent)
    bullet = json.loads(t6gps(*arguments).stdout)
    second = json.loads(t6gps(*arguments, "--engine", "mujoco").stdout)
    assert bullet.keys() == second.keys()
    assert bullet["cost"] != second["cost"]
    assert bullet["cost"]["mean"] == pytest.approx(second["cost"]["mean"], abs=0.2)
