"""Contract: the compiled observer and its definition in Python are the same."""

import numpy as np
import pytest

from t6gps.workers.episode.start import random_start
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics import observer
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.observation import observe
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter, support_face
from t6gps.workers.robot.symmetry import CABLE_MAP, frame_yaw
from t6gps.workers.settings import RobotSettings


@pytest.fixture(scope="module")
def states() -> list[RobotState]:
    """States of random motion from several starts: all faces and elements come up."""
    robot, rng = RobotSettings(winch_speed_m_per_s=1.5, shortest_command_m=0.5), np.random.default_rng(0)
    states = []
    with PyBulletEngine(robot) as engine:
        for _ in range(12):
            random_start(engine, robot, None, rng)
            states += [engine.control_step(rng.uniform(0.5, 1.35, 24)) for _ in range(60)]
    return states


def test_survey_finds_the_support_face_and_the_centre_of_mass(states: list[RobotState]) -> None:
    faces = set()
    for state in states:
        face, *com = observer.survey(state)
        assert face == support_face(state.nodes(), state.com)
        assert np.allclose(com, state.com, rtol=0, atol=1e-14)
        faces.add(face)
    assert len(faces) > 15


def test_observations_and_turns_are_those_of_the_definition(states: list[RobotState]) -> None:
    elements, frame = set(), None
    for number, state in enumerate(states):
        nodes, com = state.nodes(), state.com
        face = support_face(nodes, com)
        frame = enter(face, frame if number % 3 else None, state)
        target = (0.6, -0.8)
        yaw, observation = observer.observe(state, frame, target, 1.088)
        expected = frame_yaw(nodes, face, frame.element)
        assert abs(yaw - expected) < 1e-13
        assert np.allclose(observation, observe(state, frame, expected, np.array(target), 1.088), rtol=1e-6, atol=1e-7)
        elements.add(frame.element)
    assert len(elements) > 15


def test_extremes_are_those_of_the_nodes_and_the_ground(states: list[RobotState]) -> None:
    terrain = generate(3, 1.0, size_m=5.0)  # smaller than the way of the robot: many nodes are beyond its sides
    beyond = 0
    for state in states:
        nodes = state.nodes()
        side, depth = observer.extremes(state, terrain)
        assert side == pytest.approx(np.abs(nodes[:, :2]).max(), rel=0, abs=1e-13)
        below = terrain.height(nodes[:, 0], nodes[:, 1]) - nodes[:, 2]
        assert depth == pytest.approx(below.max(), rel=0, abs=1e-13)
        beyond += side > terrain.half_size_m
    assert 0 < beyond < len(states)


def test_steering_keeps_to_the_range_and_maps_labels_back() -> None:
    rng = np.random.default_rng(1)
    for element in range(24):
        mean, departure = rng.uniform(0.3, 1.7, 24), rng.normal(size=24)
        within, command, action = observer.steer(mean, departure, element, 0.5, 1.5)
        assert np.array_equal(within, mean.clip(0.5, 1.5))
        assert np.array_equal(command, (within[CABLE_MAP[element]] + departure).clip(0.5, 1.5))
        assert np.array_equal(action[CABLE_MAP[element]], command)


def test_what_does_not_fit_is_refused(states: list[RobotState]) -> None:
    state = states[0]
    short = RobotState(state.bars[:5], state.rest_lengths)
    single = RobotState(state.bars.astype(np.float32), state.rest_lengths)
    for bad in (short, single):
        with pytest.raises(ValueError, match=r"expected float64 \[6, 13\]"):
            observer.survey(bad)
    with pytest.raises(ValueError, match=r"expected float64 \[n, n\]"):
        observer.extremes(state, Terrain(np.zeros((3, 4)), 0.5))
    with pytest.raises(ValueError, match="out of range"):
        observer.observe(state, SupportFrame(20, 0, 0, None), (1.0, 0.0), 1.088)
    with pytest.raises(ValueError, match="out of range"):
        observer.steer(np.zeros(24), np.zeros(24), 24, 0.5, 1.5)
    with pytest.raises(ValueError, match=r"expected float64 \[24, 1\]"):
        observer.steer(np.zeros(23), np.zeros(24), 0, 0.5, 1.5)
