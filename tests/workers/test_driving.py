"""Laws of a driven robot: left alone it is an episode, and commands do what they say."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from t6gps.storage import schema
from t6gps.storage.errors import DataError
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.workers.driving import SPEED_STEPS, DrivenRobot, Start
from t6gps.workers.robot.recorded import states
from t6gps.workers.settings import RandomisationSettings, RolloutSettings, TaskSettings
from t6gps.workers.worker import RolloutWorker

STEPS = 40
RANDOM = RandomisationSettings(mass_spread=0.2, friction_spread=0.2, sensor_noise=0.01, largest_delay_steps=2)


def policy(size: float = 0.3) -> PolicySnapshot:
    rng = np.random.default_rng(0)
    layers = tuple(
        ((size * rng.standard_normal((b, a))).astype(np.float32), np.zeros(b, dtype=np.float32))
        for a, b in pairwise([schema.OBSERVATION_N, 16, 24])
    )
    return PolicySnapshot(3, layers, offset_m=1.088, scale_m=0.2)


STANDING = policy(0.0)


@pytest.fixture
def robot() -> Iterator[DrivenRobot]:
    """A robot that moves under a random policy."""
    made = DrivenRobot(RolloutSettings(), policy(), Start(123, 5, 0.0, 7))
    yield made
    made.close()


@pytest.mark.parametrize(
    ("settings", "difficulty"),
    [
        (RolloutSettings(), 0.0),
        (RolloutSettings(randomisation=RANDOM), 0.8),
        (RolloutSettings(task=TaskSettings(directions=12)), 0.0),
    ],
    ids=["flat", "rough and randomised", "directions"],
)
def test_a_robot_that_is_left_alone_is_the_noise_free_episode_of_its_plan(
    settings: RolloutSettings, difficulty: float
) -> None:
    plan = EpisodePlan(
        episode_id=7,
        iteration=0,
        index=7,
        seed=123,
        steps=STEPS,
        terrain_seed=5,
        terrain_difficulty=difficulty,
        noise_std_m=0.0,
        policy_version=3,
    )
    frames = RolloutWorker(settings).run(plan, policy()).frames
    stored, faces = states(frames), frames["face"].to_pylist()
    waypoints = list(zip(*(frames[f"waypoint_{axis}_m"].to_pylist() for axis in "xy"), strict=True))
    robot = DrivenRobot(settings, policy(), Start(123, 5, difficulty, 7))
    for _ in range(2):  # once more after a start of its own
        for row in range(STEPS + 1):
            sight = robot.sight()
            np.testing.assert_allclose(sight.nodes_m, stored.nodes()[row], atol=2e-6)  # stored as float32
            assert (sight.face, sight.waypoint_m) == (faces[row], pytest.approx(waypoints[row]))
            robot.step()
        robot.begin(Start(123, 5, difficulty, 7))
    robot.close()


@pytest.mark.parametrize("difficulty", [0.0, 0.8])
def test_a_push_changes_the_momentum_by_its_impulse(robot: DrivenRobot, difficulty: float) -> None:
    robot.begin(Start(123, 5, difficulty, 7))
    robot.step()
    before, nodes = robot.momentum, robot.sight().nodes_m
    robot.push(np.array([30.0, -20.0, 10.0]))
    np.testing.assert_allclose(robot.momentum - before, [30.0, -20.0, 10.0], atol=1e-9)
    np.testing.assert_allclose(robot.sight().nodes_m, nodes, atol=1e-9)


def test_a_push_against_the_way_back_moves_the_robot_and_friction_brakes_it() -> None:
    way = {}
    for friction in (0.05, 1.5):
        robot = DrivenRobot(RolloutSettings(), STANDING, Start(123, 5, 0.0, 7))
        robot.set_friction(friction)
        start = robot.sight().com_m
        robot.push(np.array([60.0, 0.0, 0.0]))
        for _ in range(10):
            robot.step()
        way[friction] = robot.sight().com_m[0] - start[0]
        robot.close()
    assert way[0.05] > way[1.5] + 0.2
    assert way[1.5] > 0.05


def test_a_waypoint_holds_until_another_one_is_given_and_through_a_start(robot: DrivenRobot) -> None:
    x, y, _ = robot.sight().com_m
    robot.head_for(x + 3.0, y)
    for _ in range(60):  # longer than a waypoint of the task lasts
        robot.step()
    robot.begin(Start(123, 5, 0.5, 7))
    sight = robot.sight()
    assert sight.waypoint_m == (x + 3.0, y)
    assert sight.distance_m == pytest.approx(np.hypot(*(sight.com_m[:2] - [x + 3.0, y])))


def test_the_time_to_a_waypoint_is_told_once_it_is_reached(robot: DrivenRobot) -> None:
    x, y, _ = robot.sight().com_m
    robot.head_for(x + 50.0, y)
    robot.step()
    assert robot.sight().reached_after_s is None
    robot.head_for(x + 0.1, y)
    for _ in range(3):
        robot.step()
    assert robot.sight().reached_after_s == pytest.approx(0.1)


def test_the_speed_is_the_way_over_the_last_seconds(robot: DrivenRobot) -> None:
    places = [robot.sight().com_m[:2]]
    for _ in range(SPEED_STEPS + 10):
        robot.step()
        places.append(robot.sight().com_m[:2])
    way = np.hypot(*(places[-1] - places[-1 - SPEED_STEPS]))
    assert robot.sight().speed_m_per_s == pytest.approx(way / 3.0)


def test_a_robot_whose_state_is_unsound_says_why_stands_still_and_begins_again(robot: DrivenRobot) -> None:
    robot.push(np.array([5000.0, 0.0, 0.0]))
    robot.step()
    stopped = robot.sight()
    assert stopped.ended_by == "unstable"
    robot.push(np.array([1.0, 0.0, 0.0]))
    robot.step()
    np.testing.assert_array_equal(robot.sight().nodes_m, stopped.nodes_m)
    robot.begin(Start(123, 5, 0.0, 7))
    robot.step()
    assert robot.sight().ended_by is None


def test_a_policy_that_does_not_fit_is_refused() -> None:
    wide = PolicySnapshot(3, ((np.zeros((24, 7), np.float32), np.zeros(24, np.float32)),), 1.0, 0.2)
    with pytest.raises(DataError, match="policy version 3"):
        DrivenRobot(RolloutSettings(), wide, Start(0, 0, 0.0, 0))
