"""Laws of what rivals see, command and earn: the columns that T6-GPS learns from, and its episodes of training."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.studies.rivals.environment import RivalEnvironment
from t6gps.service.studies.rivals.headings import HeadingBuffer
from t6gps.service.studies.rivals.senses import VELOCITY, Actions, Array, Floats, command, reward, senses
from t6gps.storage.records import Episode
from t6gps.storage.schema import OBSERVATION_N, TARGET, array
from t6gps.workers.episode.rollout import controlled
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.symmetry import CABLES_FROM

STEPS = 60
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (STEPS, 24)).astype(np.float32)


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load("rough", [f"run.steps={STEPS}", "run.episodes=2", "exploration.noise_std_m=0"])


@pytest.fixture(scope="module")
def environment(config: Config) -> Iterator[RivalEnvironment]:
    with RivalEnvironment(config, Actions.RATES) as environment:
        yield environment


def recorded(config: Config, actions: Actions) -> tuple[Episode, Floats]:
    """The first episode of training under ACTIONS, and what a rival sees at its steps."""
    seen = []

    def control(episode: RunningEpisode, step: int) -> Array:
        seen.append(senses(episode))
        return command(actions, ACTIONS[step], episode, config.robot)

    plan = seeding.training_plans(config, 0)[0]
    with PyBulletEngine(config.robot) as engine:
        episode = controlled(engine, config.rollout, plan, control, 0, nominal_rest_length(config.robot))
    return episode, np.array(seen)


@pytest.mark.parametrize("actions", Actions)
def test_a_rival_learns_on_the_episodes_of_training_and_sees_their_columns(config: Config, actions: Actions) -> None:
    episode, seen = recorded(config, actions)
    rows = len(seen)
    for columns, name in (
        (slice(OBSERVATION_N), "observation"),
        (VELOCITY, "com_velocity"),
        (slice(VELOCITY.stop, None), "node_velocities"),
    ):
        known = array(episode.frames, name)[:rows].reshape(rows, -1)
        np.testing.assert_allclose(seen[:, columns], known, atol=1e-5)
    target = config.task.target_speed_m_per_s
    with RivalEnvironment(config, actions) as environment:
        np.testing.assert_array_equal(environment.reset()[0], seen[0])
        for step, action in enumerate(ACTIONS):
            observed, earned, terminated, truncated, _ = environment.step(action)
            cost = array(episode.frames, "cost")[step + 1]
            assert earned == pytest.approx((target**2 - cost) / (2 * target), abs=1e-5)
            assert (terminated, truncated) == (False, step == STEPS - 1)
            if step < STEPS - 1:
                np.testing.assert_allclose(observed, seen[step + 1], atol=1e-5)


def test_rest_earns_nothing_and_the_target_speed_the_most(config: Config) -> None:
    target, ahead = config.task.target_speed_m_per_s, np.array([0.6, 0.8])
    assert reward(np.zeros(3), ahead, config.task) == 0
    assert reward(target * np.append(ahead, 0), ahead, config.task) == pytest.approx(target / 2)
    assert reward(np.array([-0.1, 0, 0]), np.array([1.0, 0]), config.task) < 0


def test_a_rate_of_zero_holds_and_one_moves_as_far_as_the_winch_reaches(config: Config) -> None:
    plan = seeding.training_plans(config, 0)[0]
    with PyBulletEngine(config.robot) as engine:
        episode = RunningEpisode(
            engine, config.rollout, plan.seed, plan.terrain_seed, 1.0, nominal_rest_length(config.robot)
        )
        present = episode.state.rest_lengths[CABLES_FROM[episode.frame.element]]
        for action, moved_m in ((0.0, 0.0), (1.0, 0.07), (-1.0, -0.07)):
            wanted = command(Actions.RATES, np.full(24, action, np.float32), episode, config.robot)
            np.testing.assert_allclose(wanted - present, moved_m, atol=1e-6)
        for action, length_m in ((-1.0, 0.5), (1.0, 1.5)):
            wanted = command(Actions.ABSOLUTE, np.full(24, action, np.float32), episode, config.robot)
            np.testing.assert_allclose(wanted, length_m)


def test_a_state_out_of_range_ends_the_episode_at_rest() -> None:
    """A robot of coarse physics steps whose bars spin freely stands, but does not bear fast winches."""
    fragile = configuration.load(
        "flat",
        [
            "robot.physics_step_s=0.01",
            "robot.axial_inertia_kg_m2=0.01",
            "robot.axial_damping_n_m_s=0",
            "robot.cable_max_tension_n=10000",
            "robot.winch_speed_m_per_s=2",
            "robot.shortest_command_m=0.4",
        ],
    )
    with RivalEnvironment(fragile, Actions.ABSOLUTE) as environment:
        environment.reset()
        extremes = np.where(np.random.default_rng(1).random((250, 24)) < 0.5, -1, 1).astype(np.float32)
        ends = (environment.step(action) for action in extremes)
        _, earned, _, truncated, _ = next(end for end in ends if end[2])
        assert (earned, truncated) == (0.0, False)
        environment.reset()
        assert np.isfinite(environment.step(extremes[0])[1])


def test_turned_waypoints_are_the_same_in_both_frames_and_earn_their_own_reward(
    config: Config, environment: RivalEnvironment
) -> None:
    buffer = HeadingBuffer(
        STEPS,
        environment.observation_space,
        environment.action_space,
        task=config.task,
        rng=np.random.default_rng(0),
    )
    seen, _ = environment.reset()
    known = {}
    for action in ACTIONS:
        following, earned, terminated, _, info = environment.step(action)
        buffer.add(seen, following, action, np.array(earned), np.array(terminated), [info])
        known[seen[VELOCITY].tobytes()] = (seen, following, info["frames"])
        seen = following
    assert len({frames for *_, frames in known.values()}) > 1
    samples = buffer.sample(2000)
    own_n, headings = 0, []
    for observed, next_observed, earned in zip(
        samples.observations.numpy(), samples.next_observations.numpy(), samples.rewards.numpy(), strict=True
    ):
        before, after, (turn, side, next_turn, next_side) = known[observed[VELOCITY].tobytes()]
        own_n += np.array_equal(observed, before) and np.array_equal(next_observed, after)
        world = side * (np.arctan2(observed[TARGET][1], observed[TARGET][0]) - turn)
        next_world = next_side * (np.arctan2(next_observed[TARGET][1], next_observed[TARGET][0]) - next_turn)
        gap = (next_world - world + np.pi) % (2 * np.pi) - np.pi
        assert abs(gap) < 0.3, "the robot itself moves a little, the frame may turn and mirror"
        headings.append(world % (2 * np.pi))
        velocity, direction = next_observed[VELOCITY].astype(float), next_observed[TARGET].astype(float)
        assert earned[0] == pytest.approx(float(reward(velocity, direction, config.task)), abs=1e-4)
    assert own_n == pytest.approx(1000, abs=100)
    assert min(np.histogram(headings, 4, (0, 2 * np.pi))[0]) > 150, "in every direction"
