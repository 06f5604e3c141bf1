"""Laws of exported policies: each format commands what the run's own policy commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from exported_policies import Material

from t6gps.service.policies import tables
from t6gps.service.policies.driver import START, Array, Measurement, State, measured
from t6gps.service.policies.driving import control
from t6gps.service.policies.files import Format
from t6gps.storage import schema
from t6gps.workers.episode import policy as acting
from t6gps.workers.robot.observation import observe
from t6gps.workers.robot.recorded import in_order, numbers, states
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter, support_face
from t6gps.workers.robot.symmetry import BARS_FROM, CABLE_MAP, CABLES_FROM, NODES_FROM, frame_yaw, world_map
from t6gps.workers.robot.topology import BARS_N, FACE_KINDS, NODES_M
from t6gps.workers.worker import RolloutWorker

TOLERANCE_M = 2e-6
"""Commands agree to this with those of the definitions, which sum products and round observations in another order."""
STORED_M = 1e-5
"""Frames hold states with 32 bits; commands of what is read back from them agree to this."""
NEIGHBOURS = [(face, element) for face, element in np.argwhere((tables.INTS["transition"] >= 0).any(axis=2)).tolist()]
"""All 48 frames of support triangles: those from which some triangle is entered."""


def stored(material: Material) -> Iterator[tuple[Measurement, tuple[int, int], Array]]:
    """What is measured in each frame of an episode that has an action, its support frame, and the commands."""
    frames = material.episode.frames.slice(0, material.episode.frames.num_rows - 1)
    all_states, commands = states(frames), in_order(frames, "action_mean")
    ways = np.stack([numbers(frames, name) for name in ("waypoint_x_m", "waypoint_y_m")], axis=1)
    labels = np.stack([schema.array(frames, name) for name in ("face", "element")], axis=1)
    for row in range(frames.num_rows):
        state = RobotState(all_states.bars[row], all_states.rest_lengths[row])
        yield measured(state, (ways[row, 0], ways[row, 1])), tuple(labels[row].tolist()), commands[row]


def image(of: Measurement, element: int, yaw_rad: float) -> Measurement:
    """What is measured of the robot relabelled by an element, in a world that is mirrored with it and turned."""
    world = world_map(element, yaw_rad)
    return Measurement(
        (of.nodes @ world.T)[NODES_FROM[element]],
        world @ of.com_velocity,
        np.linalg.det(world) * (of.bar_angular_velocities @ world.T)[BARS_FROM[element]],
        of.rest_lengths[CABLES_FROM[element]],
        world[:2, :2] @ of.waypoint,
    )


def tumbled(rng: np.random.Generator) -> RobotState:
    """The robot in any shape and orientation, on the move."""
    orthogonal, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    orthogonal *= np.sign(np.diag(upper))
    nodes = (NODES_M + rng.normal(scale=0.03, size=NODES_M.shape)) @ (orthogonal * np.linalg.det(orthogonal)).T
    axes = nodes[0::2] - nodes[1::2]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = np.column_stack([-axes[:, 1], axes[:, 0], np.zeros(BARS_N), 1 + axes[:, 2]])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    centres = (nodes[0::2] + nodes[1::2]) / 2 + [3.0, -5.0, 1.0]
    moving = (rng.standard_normal((BARS_N, 3)) for _ in range(2))
    return RobotState.of(centres, turns, *moving, rng.uniform(0.8, 1.2, 24))


def expected(material: Material, state: RobotState, way: Array, before: SupportFrame | None) -> tuple[State, Array]:
    """Support frame and commands by the definitions of the robot and the policy of the run."""
    nodes = state.nodes()
    face = support_face(nodes, state.com)
    frame = before if before is not None and before.face == face else enter(face, before, state)
    gap = way - state.com[:2]
    yaw_rad = frame_yaw(nodes, face, frame.element)
    observation = observe(state, frame, yaw_rad, gap / np.hypot(*gap), material.snapshot.offset_m)
    robot = material.config.robot
    commands = acting.ready(material.snapshot)(observation).clip(robot.shortest_command_m, robot.longest_command_m)
    return np.array([face, frame.element]), commands[CABLE_MAP[frame.element]]


def test_actions_over_stored_frames_are_those_of_the_run(material: Material, form: Format) -> None:
    state, faces = START, set()
    for given, labels, commands in stored(material):
        found, state = material.drivers[form].decide(given, state)
        assert state.tolist() == list(labels)
        assert np.abs(found - commands).max() < STORED_M
        faces.add(labels[0])
    assert len(faces) > 2


def test_all_24_images_of_stored_frames_get_the_images_of_their_actions(material: Material, form: Format) -> None:
    for element in range(24):
        state = START
        for given, _, commands in stored(material):
            found, state = material.drivers[form].decide(image(given, element, 0.3 * element), state)
            assert np.abs(found - commands[CABLES_FROM[element]]).max() < STORED_M


def test_actions_after_each_support_triangle_and_element_are_those_of_the_definitions(
    material: Material, form: Format
) -> None:
    assert len(NEIGHBOURS) == 48
    rng = np.random.default_rng(0)
    reached = set()
    for face, element in [*NEIGHBOURS, *NEIGHBOURS, *NEIGHBOURS, (-1, -1)] * 3:
        robot, way = tumbled(rng), rng.uniform(-9, 9, 2)
        before = None if face < 0 else SupportFrame(face, int(FACE_KINDS[face]), element, None)
        labels, commands = expected(material, robot, way, before)
        found, after = material.drivers[form].decide(measured(robot, (way[0], way[1])), np.array([face, element]))
        assert np.array_equal(after, labels)
        assert np.abs(found - commands).max() < TOLERANCE_M
        reached.add(int(labels[0]))
    assert reached == set(range(20))


def test_at_the_waypoint_and_beside_any_triangle_commands_are_finite(material: Material, form: Format) -> None:
    robot = tumbled(np.random.default_rng(1))
    found, _ = material.drivers[form].decide(measured(robot, (robot.com[0], robot.com[1])), START)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_one_number_that_is_not_finite_gives_no_commands_and_leaves_the_state(
    material: Material, form: Format, lost: float
) -> None:
    robot, before = tumbled(np.random.default_rng(2)), np.array([3, 8])
    given = measured(robot, (3.0, 1.0))
    sizes = [np.size(part) for part in vars(given).values()]
    for number in range(sum(sizes)):
        values = np.concatenate([np.ravel(part) for part in vars(given).values()])
        values[number] = lost
        parts = zip(np.split(values, np.cumsum(sizes)[:-1]), vars(given).values(), strict=True)
        commands, after = material.drivers[form].decide(Measurement(*(a.reshape(b.shape) for a, b in parts)), before)
        assert np.isnan(commands).all(), number
        assert np.array_equal(after, before)


def test_an_episode_driven_by_a_file_is_that_of_the_policy(material: Material, form: Format) -> None:
    worker = RolloutWorker(material.config.rollout)
    described = material.drivers[form].description
    driven = worker.drive(material.plan, control(material.drivers[form]), described.policy_version, described.offset_m)
    worker.close()
    own = material.episode
    if form is Format.C:
        assert driven.frames.equals(own.frames)
        assert driven.summary.equals(own.summary)
    for name in ("action_mean", "nodes", "observation"):  # of the first second: contacts enlarge the least difference
        found, wanted = (numbers(episode.frames.slice(0, 10), name) for episode in (driven, own))
        assert np.abs(found - wanted).max() < 1e-4
