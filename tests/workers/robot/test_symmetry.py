"""Laws of the topology, the symmetry group and the canonical frames."""

import numpy as np
import pytest

from t6gps.workers.robot.observation import observe
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter, exit_edge, support_face
from t6gps.workers.robot.symmetry import (
    BAR_MAP,
    BARS_FROM,
    CABLE_MAP,
    CABLES_FROM,
    EDGE_MAP,
    ELEMENTS_N,
    FACE_MAP,
    MATRICES,
    NODE_MAP,
    NODES_FROM,
    PROPER,
    REFERENCE_FACE,
    REFERENCE_TRIANGLES_M,
    frame_yaw,
    world_map,
)
from t6gps.workers.robot.topology import (
    BAR_LENGTH_M,
    BARS,
    CABLE_LENGTH_M,
    CABLES,
    DELTA,
    FACE_KINDS,
    FACES,
    LAMBDA,
    NEIGHBOR_EDGE,
    NEIGHBOR_FACE,
    NODES_M,
)


def test_bars_and_cables_have_the_lengths_of_the_icosahedral_tensegrity() -> None:
    assert np.allclose(np.linalg.norm(np.diff(NODES_M[BARS], axis=1), axis=2), BAR_LENGTH_M)
    assert np.allclose(np.linalg.norm(np.diff(NODES_M[CABLES], axis=1), axis=2), CABLE_LENGTH_M)
    assert CABLES.shape == (24, 2)
    assert np.bincount(CABLES.ravel()).tolist() == [4] * 12


def test_there_are_8_delta_and_12_lambda_faces_counter_clockwise_from_outside() -> None:
    assert np.bincount(FACE_KINDS).tolist() == [8, 12]
    a, b, c = np.moveaxis(NODES_M[FACES], 1, 0)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()


def test_adjacency_is_mutual_and_deltas_meet_only_lambdas() -> None:
    for face, edge in np.ndindex(20, 3):
        other, other_edge = NEIGHBOR_FACE[face, edge], NEIGHBOR_EDGE[face, edge]
        assert NEIGHBOR_FACE[other, other_edge] == face
        if FACE_KINDS[face] == DELTA:
            assert FACE_KINDS[other] == LAMBDA
            assert other_edge != 0
        elif edge == 0:
            assert FACE_KINDS[other] == LAMBDA
            assert other_edge == 0


def test_the_24_maps_are_distinct_and_form_a_group() -> None:
    assert ELEMENTS_N == 24
    assert PROPER.sum() == 12
    products = np.einsum("aij,bjk->abik", MATRICES, MATRICES)
    gaps = np.abs(products[:, :, None] - MATRICES[None, None]).max(axis=(3, 4))
    index = gaps.argmin(axis=2)
    assert gaps.min(axis=2).max() < 1e-12
    assert all(sorted(row) == list(range(24)) for row in index)
    assert np.array_equal(NODE_MAP[index], NODE_MAP[:, NODE_MAP])


@pytest.mark.parametrize("element", range(24))
def test_every_map_carries_each_node_bar_cable_and_face_to_one(element: int) -> None:
    assert np.allclose(NODES_M @ MATRICES[element].T, NODES_M[NODE_MAP[element]], atol=1e-12)
    for pairs, pair_map in ((BARS, BAR_MAP), (CABLES, CABLE_MAP)):
        assert sorted(pair_map[element]) == list(range(len(pairs)))
        assert np.array_equal(np.sort(NODE_MAP[element][pairs]), np.sort(pairs[pair_map[element]]))
    assert sorted(FACE_MAP[element]) == list(range(20))
    assert np.array_equal(np.sort(NODE_MAP[element][FACES]), np.sort(FACES[FACE_MAP[element]]))
    assert np.array_equal(FACE_KINDS, FACE_KINDS[FACE_MAP[element]])


def test_stabilisers_have_three_rotations_for_a_delta_and_a_mirror_for_a_lambda() -> None:
    for face, kind in enumerate(FACE_KINDS):
        stabiliser = np.flatnonzero(FACE_MAP[:, face] == face)
        assert (len(stabiliser), PROPER[stabiliser].sum()) == ((3, 3) if kind == DELTA else (2, 1))


def _random_state(rng: np.random.Generator) -> RobotState:
    """A deformed robot in a random orientation."""
    turn, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.sign(np.diag(upper))
    turn *= np.linalg.det(turn)
    nodes = (NODES_M + 0.05 * rng.standard_normal(NODES_M.shape)) @ turn.T + [1.0, -2.0, 0.9]
    axes = nodes[0::2] - nodes[1::2]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    # The shortest turn from z to the axis, followed by a random spin about it.
    shortest = np.column_stack([-axes[:, 1], axes[:, 0], np.zeros(6), 1 + axes[:, 2]])
    shortest /= np.linalg.norm(shortest, axis=1, keepdims=True)
    return RobotState.of(
        (nodes[0::2] + nodes[1::2]) / 2,
        shortest,
        rng.standard_normal((6, 3)),
        rng.standard_normal((6, 3)),
        rng.uniform(0.8, 1.2, 24),
    )


def _copy(state: RobotState, element: int, yaw: float) -> RobotState:
    """The state relabelled by `element`, in a world mirrored if it is improper and turned by `yaw`."""
    world = world_map(element, yaw)
    side = np.linalg.det(world)
    bars = BARS_FROM[element]
    nodes = (state.nodes() @ world.T)[NODES_FROM[element]]
    axes = (nodes[0::2] - nodes[1::2]) / BAR_LENGTH_M
    quaternions = np.column_stack([-axes[:, 1], axes[:, 0], np.zeros(6), 1 + axes[:, 2]])
    return RobotState.of(
        (state.bar_positions @ world.T)[bars],
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        (state.bar_velocities @ world.T)[bars],
        side * (state.bar_angular_velocities @ world.T)[bars],
        state.rest_lengths[CABLES_FROM[element]],
    )


def _frame(state: RobotState, previous: SupportFrame | None = None) -> tuple[SupportFrame, float]:
    nodes = state.nodes()
    frame = enter(support_face(nodes, state.com), previous, state)
    return frame, frame_yaw(nodes, frame.face, frame.element)


def test_every_face_reaches_its_reference_and_the_reference_orientation() -> None:
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(300):
        state = _random_state(rng)
        frame, yaw = _frame(state)
        seen.add(frame.face)
        reference = REFERENCE_FACE[frame.kind]
        assert FACE_MAP[frame.element, frame.face] == reference
        canonical = (state.nodes() @ world_map(frame.element, yaw).T)[NODES_FROM[frame.element]]
        corners = canonical[FACES[reference], :2]
        corners -= corners.mean(axis=0)
        goal = REFERENCE_TRIANGLES_M[frame.kind]
        twist = (corners[:, 0] * goal[:, 1] - corners[:, 1] * goal[:, 0]).sum()
        assert abs(twist) < 1e-12
        assert (corners * goal).sum() > 0
    assert seen == set(range(20))


def test_canonical_states_map_back_to_the_world_state() -> None:
    rng = np.random.default_rng(1)
    for _ in range(100):
        state = _random_state(rng)
        frame, yaw = _frame(state)
        world = world_map(frame.element, yaw)
        assert np.allclose(world @ world.T, np.eye(3), atol=1e-15)
        canonical = (state.nodes() @ world.T)[NODES_FROM[frame.element]]
        assert np.allclose(canonical[NODE_MAP[frame.element]] @ world, state.nodes(), atol=1e-14)
        rest = state.rest_lengths[CABLES_FROM[frame.element]]
        assert np.array_equal(rest[CABLE_MAP[frame.element]], state.rest_lengths)


@pytest.mark.parametrize("element", range(24))
def test_all_copies_of_a_state_give_the_same_observation(element: int) -> None:
    rng = np.random.default_rng(element)
    for _ in range(20):
        state = _random_state(rng)
        yaw, target = rng.uniform(-np.pi, np.pi), np.array([0.6, -0.8])
        copy = _copy(state, element, yaw)
        first, later = _frame(state), _frame(copy)
        copied_target = world_map(element, yaw)[:2, :2] @ target
        assert first[0].kind == later[0].kind
        for neighbour in (None, 0, 1, 2):
            # Entered from nowhere, or through each edge in turn.
            if neighbour is not None:
                origin = int(NEIGHBOR_FACE[first[0].face, neighbour])
                before = enter(origin, None, state)
                copied_before = enter(int(FACE_MAP[element, origin]), None, copy)
                first, later = _frame(state, before), _frame(copy, copied_before)
            assert first[0].entry_edge == later[0].entry_edge
            a = observe(state, *first, target, 1.088)
            b = observe(copy, *later, copied_target, 1.088)
            assert np.allclose(a, b, atol=1e-5)


def test_the_entry_edge_is_the_reference_edge() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        state = _random_state(rng)
        face = support_face(state.nodes(), state.com)
        for edge in range(3):
            other = int(NEIGHBOR_FACE[face, edge])
            previous = enter(other, None, state)
            frame = enter(face, previous, state)
            assert frame.entry_edge == (0 if frame.kind == DELTA or edge == 0 else 1)
            assert exit_edge(previous, face) == EDGE_MAP[previous.element, other, NEIGHBOR_EDGE[face, edge]]


def test_labels_map_across_each_kind_of_edge_in_one_way_only() -> None:
    """What a linear model of the crossing relies on: kind and exit edge decide the change of labels."""
    rng = np.random.default_rng(5)
    changes: dict[tuple[int, int], set[tuple[int, ...]]] = {}
    for _ in range(300):
        state = _random_state(rng)
        previous = enter(int(rng.integers(20)), None, state)
        for face in NEIGHBOR_FACE[previous.face]:
            frame = enter(int(face), previous, state)
            edge = exit_edge(previous, int(face))
            assert edge is not None
            change = tuple(NODE_MAP[frame.element][NODES_FROM[previous.element]])
            changes.setdefault((previous.kind, edge), set()).add(change)
    assert sorted(changes) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert {len(change) for change in changes.values()} == {1}


def test_the_support_triangle_of_the_standing_robot_is_the_face_it_stands_on() -> None:
    for face, corners in enumerate(NODES_M[FACES]):
        down = corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0))
        side = np.cross(down, [0.3, 0.5, 0.8])
        side /= np.linalg.norm(side)
        nodes = NODES_M @ np.stack([side, np.cross(side, down), -down], axis=1)
        assert support_face(nodes, np.zeros(3)) == face


def test_without_a_face_below_the_centre_the_lowest_face_supports() -> None:
    nodes = NODES_M + [10.0, 0.0, 0.0]
    assert support_face(nodes, np.zeros(3)) == NODES_M[FACES][:, :, 2].sum(axis=1).argmin()
