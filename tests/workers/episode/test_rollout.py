"""Laws of an episode: what is recorded is what happened, and it depends on plan and policy alone."""

import pickle
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import schema
from t6gps.storage.errors import DataError, PhysicsError, UnsoundStateError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.episode import policy
from t6gps.workers.episode.exploration import noise
from t6gps.workers.episode.recording import canonical_vectors, stuck_share_by_distance
from t6gps.workers.episode.start import SETTLE_STEPS
from t6gps.workers.episode.task import AREA_HALF_WIDTH_M, Course, random_waypoints, running_cost
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Engine
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.symmetry import CABLES_FROM, NODE_MAP, NODES_FROM, world_map
from t6gps.workers.robot.topology import NEIGHBOR_FACE, NODES_M
from t6gps.workers.settings import RobotSettings, RolloutSettings, TaskSettings
from t6gps.workers.worker import RolloutWorker

FRESH_PROCESS = """
import pickle, sys
import pyarrow as pa
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker

frames = RolloutWorker(RolloutSettings()).run(*pickle.load(sys.stdin.buffer)).frames
with pa.ipc.new_stream(sys.stdout.buffer, frames.schema) as stream:
    stream.write_table(frames)
"""
PLAN = EpisodePlan(
    episode_id=7,
    iteration=0,
    index=7,
    seed=123,
    steps=40,
    terrain_seed=5,
    terrain_difficulty=0.0,
    noise_std_m=0.15,
    policy_version=0,
)


def random_policy(seed: int = 0, size: float = 0.3) -> PolicySnapshot:
    rng = np.random.default_rng(seed)
    widths = [schema.OBSERVATION_N, 16, 24]
    layers = tuple(
        ((size * rng.standard_normal((b, a))).astype(np.float32), np.zeros(b, dtype=np.float32))
        for a, b in pairwise(widths)
    )
    return PolicySnapshot(3, layers, offset_m=1.088, scale_m=0.2)


@pytest.fixture(scope="module")
def worker() -> RolloutWorker:
    return RolloutWorker(RolloutSettings())


@pytest.fixture(scope="module")
def flat(worker: RolloutWorker) -> Episode:
    return worker.run(PLAN, random_policy())


@pytest.mark.slow
@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_an_episode_is_the_same_to_the_last_bit_in_a_used_worker_and_a_fresh_process(
    worker: RolloutWorker, difficulty: float
) -> None:
    plan = replace(PLAN, terrain_difficulty=difficulty)
    used = worker.run(plan, random_policy())
    worker.run(replace(plan, seed=1, terrain_seed=1), random_policy())
    again = worker.run(plan, random_policy())
    assert used.frames.equals(again.frames)
    assert used.summary.equals(again.summary)
    fresh = subprocess.run(
        [sys.executable, "-c", FRESH_PROCESS],
        input=pickle.dumps((plan, random_policy())),
        capture_output=True,
        check=True,
    )
    assert pa.ipc.open_stream(fresh.stdout).read_all().equals(used.frames)


def test_a_seed_decides_the_episode(worker: RolloutWorker, flat: Episode) -> None:
    other = worker.run(replace(PLAN, seed=124), random_policy())
    assert not other.frames.column("com_x_m").equals(flat.frames.column("com_x_m"))


def test_row_t_holds_state_t_and_the_action_taken_there(flat: Episode) -> None:
    frames = flat.frames
    assert frames.num_rows == PLAN.steps + 1
    assert frames["step"].to_pylist() == list(range(PLAN.steps + 1))
    for name in ("action", "action_mean"):
        assert frames[name].null_count == 1
        assert not frames[name][PLAN.steps].is_valid
    snapshot = random_policy()
    observations, means = schema.array(frames, "observation"), schema.array(frames, "action_mean")
    for observation, mean in zip(observations[:-1], means, strict=True):
        assert np.allclose(np.clip(policy.ready(snapshot)(observation), 0.5, 1.5), mean, atol=1e-6)


def test_without_noise_the_policy_mean_is_the_action(worker: RolloutWorker) -> None:
    frames = worker.run(replace(PLAN, noise_std_m=0.0), random_policy()).frames
    assert frames["action"].equals(frames["action_mean"])


@pytest.fixture(scope="module")
def within_reach(worker: RolloutWorker) -> Episode:
    return worker.run(replace(PLAN, noise_std_m=0.05, within_reach=True), random_policy())


def test_noise_within_the_reach_departs_from_what_winches_reach_and_is_white(within_reach: Episode) -> None:
    names = ("observation", "rest_lengths", "action", "action_mean")
    observations, rest_lengths, actions, means = (schema.array(within_reach.frames, name) for name in names)
    act, reach = policy.ready(random_policy()), 0.1 * RolloutSettings().robot.winch_speed_m_per_s
    for observation, rest, mean in zip(observations, rest_lengths, means, strict=False):
        reached = np.clip(act(observation), rest - reach, rest + reach)
        assert np.allclose(np.clip(reached, 0.5, 1.5), mean, atol=1e-6)
    noise = actions - means
    free = (actions > 0.5) & (actions < 1.5)
    assert noise[free].std() == pytest.approx(0.05, rel=0.1)
    both = free[1:] & free[:-1]
    assert abs(np.corrcoef(noise[1:][both], noise[:-1][both])[0, 1]) < 0.15  # labels change with the triangle


def test_without_noise_the_reach_changes_the_command_and_not_the_motion(worker: RolloutWorker) -> None:
    plan = replace(PLAN, noise_std_m=0.0, steps=5)  # later, what is rounded otherwise has grown
    far, near = (worker.run(replace(plan, within_reach=within), random_policy()).frames for within in (False, True))
    assert not np.allclose(schema.array(far, "action"), schema.array(near, "action"), atol=0.01)
    for name in ("rest_lengths", "nodes"):
        assert np.allclose(schema.array(far, name), schema.array(near, name), atol=1e-5)


def test_canonical_columns_map_back_to_the_world(flat: Episode) -> None:
    frames = flat.frames
    rows = frames.num_rows
    element, yaw = schema.array(frames, "element"), schema.array(frames, "frame_yaw_rad")
    maps = world_map(element, yaw)
    com = np.stack([schema.array(frames, f"com_{axis}_m") for axis in "xyz"], axis=1)
    canonical = schema.array(frames, "nodes").reshape(rows, 12, 3)
    back = np.take_along_axis(canonical @ maps, NODE_MAP[element][:, :, None], axis=1) + com[:, None]
    bars = [schema.array(frames, name) for name in schema.FRAMES.names if name.startswith("bar_")]
    state = RobotState.of(*(b.reshape(rows, 6, -1).astype(float) for b in bars), np.zeros((rows, 24)))
    assert np.abs(back - state.nodes()).max() < 1e-5
    again = canonical_vectors(back - com[:, None], maps, NODES_FROM[element])
    assert np.abs(again - canonical).max() < 1e-5


def test_rest_lengths_never_outrun_the_winches(flat: Episode) -> None:
    element = schema.array(flat.frames, "element")
    canonical = schema.array(flat.frames, "rest_lengths")
    world = np.empty_like(canonical)
    np.put_along_axis(world, CABLES_FROM[element], canonical, axis=1)
    assert np.abs(np.diff(world, axis=0)).max() <= RolloutSettings().robot.winch_speed_m_per_s * 0.1 + 1e-6


def test_edges_are_recorded_where_the_triangle_changes() -> None:
    with_transitions = RolloutWorker(RolloutSettings()).run(replace(PLAN, steps=250), random_policy(size=0.6))
    rows = with_transitions.frames.select(["face", "exit_edge", "entry_edge", "element"]).to_pylist()
    changes = 0
    for now, after in pairwise(rows):
        if now["face"] == after["face"]:
            assert now["exit_edge"] is None
            assert now["entry_edge"] == after["entry_edge"]
            assert now["element"] == after["element"]
            continue
        changes += 1
        adjacent = after["face"] in NEIGHBOR_FACE[now["face"]]
        assert (now["exit_edge"] is not None) == adjacent == (after["entry_edge"] is not None)
    assert changes == with_transitions.summary["transitions"][0].as_py() > 0


def test_the_summary_agrees_with_the_frames(flat: Episode) -> None:
    summary = flat.summary.to_pylist()[0]
    moved = flat.frames.slice(1)
    for name in ("cost", "forward_speed_m_per_s"):
        assert summary[name] == pytest.approx(float(np.mean(schema.array(moved, name))))
    assert summary["stuck_share"] == np.mean(schema.array(moved, "speed_m_per_s") < 0.05)
    places = np.column_stack([schema.array(flat.frames, f"com_{axis}_m") for axis in "xyz"])
    expected = [np.linalg.norm(places[t] - places[t - 10]) < 0.05 for t in range(10, len(places))]
    assert summary["stuck_share_by_distance"] == np.mean(expected)
    assert summary["steps"] == PLAN.steps
    assert summary["ended_by"] == "completed"


def test_rocking_on_the_spot_is_stuck_by_distance_and_rolling_is_not() -> None:
    steps = np.arange(61)[:, None]
    rocking = np.hstack([0.1 * np.sin(2 * np.pi * steps / 10), 0 * steps, 0 * steps])
    rolling = np.hstack([0.05 * steps, 0 * steps, 0 * steps])
    assert stuck_share_by_distance(rocking) == 1.0
    assert stuck_share_by_distance(rolling) == 0.0
    assert stuck_share_by_distance(np.vstack([rocking, rolling[1:]])) == pytest.approx(51 / 111, abs=0.03)
    assert stuck_share_by_distance(rolling[:10]) is None


def test_with_directions_every_episode_starts_at_the_same_rest_and_heads_one_way() -> None:
    settings = RolloutSettings(task=TaskSettings(directions=4))
    worker, policy = RolloutWorker(settings), random_policy()
    sampled = [worker.run(replace(PLAN, steps=3, seed=10 + i, index=i), policy) for i in range(5)]
    worker.close()
    episodes = [episode.frames for episode in sampled]
    assert {episode.summary["waypoints_reached"][0].as_py() for episode in sampled} == {None}, "there are none to reach"
    starts = [np.concatenate([schema.array(e, n)[0] for n in ("bar_positions", "bar_orientations")]) for e in episodes]
    for start in starts:
        np.testing.assert_array_equal(start, starts[0])
    assert np.abs(schema.array(episodes[0], "bar_velocities")[0]).max() < 0.02
    assert {e["kind"][0].as_py() for e in episodes} == {0}
    ways = [[e[f"waypoint_{axis}_m"][0].as_py() - e[f"com_{axis}_m"][0].as_py() for axis in "xy"] for e in episodes]
    np.testing.assert_allclose(np.array(ways) / 1000, [[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0]], atol=1e-9)


def test_a_policy_that_does_not_fit_is_refused(worker: RolloutWorker) -> None:
    good = random_policy()
    wrong_shape = replace(good, layers=good.layers[1:])
    not_finite = replace(good, layers=((good.layers[0][0] * np.float32(np.nan), good.layers[0][1]), good.layers[1]))
    for bad in (wrong_shape, not_finite):
        with pytest.raises(DataError, match="policy version 3"):
            worker.run(PLAN, bad)


def test_exploration_noise_has_its_spread_and_correlation() -> None:
    samples = noise(np.random.default_rng(0), 0.15, 0.6, 4000)
    assert samples.shape == (4000, 24)
    assert samples.std() == pytest.approx(0.15, rel=0.02)
    for lag in (1, 3):
        assert np.mean(samples[lag:] * samples[:-lag]) / samples.var() == pytest.approx(0.6**lag, abs=0.02)


def test_waypoints_form_a_chain_within_the_area() -> None:
    settings = TaskSettings()
    for seed in range(50):
        start = np.array([14.0, -3.0])
        waypoints = random_waypoints(np.random.default_rng(seed), start, settings)
        gaps = np.linalg.norm(np.diff(np.vstack([start, waypoints]), axis=0), axis=1)
        assert (gaps >= settings.nearest_waypoint_m).all()
        assert (gaps <= settings.farthest_waypoint_m).all()
        assert np.abs(waypoints).max() <= AREA_HALF_WIDTH_M


def test_the_next_waypoint_comes_on_arrival_or_after_five_seconds() -> None:
    settings = TaskSettings(waypoints=2)
    course = Course(np.array([[3.0, 0.0], [6.0, 0.0]]), settings)
    for step in range(50):
        assert course.advance(0.0, 0.0, step * 0.1) == (3.0, 0.0)
    assert course.advance(0.0, 0.0, 5.0) == (6.0, 0.0)
    assert course.reached == 0
    assert course.advance(6.0, settings.waypoint_radius_m - 1e-9, 5.1) == (3.0, 0.0)
    assert (course.reached, course.active) == (1, 2)


def test_a_waypoint_is_reached_within_its_radius_which_is_half_the_robots_diameter_by_default() -> None:
    assert TaskSettings().waypoint_radius_m == np.linalg.norm(NODES_M[0])
    for radius_m in (0.5, 2.0):
        for place_m, reached in ((radius_m + 1e-9, 0), (radius_m - 1e-9, 1)):
            course = Course(np.array([[0.0, 0.0], [9.0, 9.0]]), TaskSettings(waypoint_radius_m=radius_m))
            course.advance(0.0, place_m, 0.1)
            assert (course.reached, course.active) == (reached, reached)


def test_the_cost_vanishes_at_the_target_velocity_and_weighs_the_vertical_less() -> None:
    settings, direction = TaskSettings(target_speed_m_per_s=0.8), np.array([0.6, 0.8])
    wanted = np.array([0.48, 0.64, 0.0])
    assert running_cost(wanted, direction, settings) == pytest.approx(0.0, abs=1e-15)
    assert running_cost(np.zeros(3), direction, settings) == pytest.approx(0.64)
    assert running_cost(wanted + [0, 0, 1.0], direction, settings) == pytest.approx(settings.vertical_weight)


class Failing(Engine):
    """Another engine that raises an error in the 13th control step of each episode."""

    def __init__(self, robot: RobotSettings, error: PhysicsError) -> None:
        self.robot, self._error = robot, error
        self._engine = PyBulletEngine(robot)

    def set_ground(self, terrain: Terrain | None) -> None:
        self._engine.set_ground(terrain)
        self._steps_n = 0

    def reset(self, state: RobotState) -> None:
        self._engine.reset(state)

    def state(self) -> RobotState:
        return self._engine.state()

    def control_step(self, command: Array) -> RobotState:
        self._steps_n += 1
        if self._steps_n == SETTLE_STEPS + 13:
            raise self._error
        return self._engine.control_step(command)

    def close(self) -> None:
        self._engine.close()


def failing_worker(error: PhysicsError) -> RolloutWorker:
    return RolloutWorker(RolloutSettings(), partial(Failing, error=error))


def test_an_unsound_state_ends_the_episode_before_it_and_is_named() -> None:
    episode = failing_worker(UnsoundStateError("a node moves too fast", "unstable")).run(PLAN, random_policy())
    assert episode.summary["ended_by"][0].as_py() == "unstable"
    assert episode.summary["steps"][0].as_py() == 12
    assert episode.frames["action"].null_count == 1


def test_a_broken_simulator_is_an_error_and_not_the_end_of_an_episode() -> None:
    with pytest.raises(PhysicsError, match="no plugin"):
        failing_worker(PhysicsError("no plugin")).run(PLAN, random_policy())
