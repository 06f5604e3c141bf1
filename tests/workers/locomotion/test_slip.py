"""Laws of slip: a dragged foot slips as far as it is dragged, one that stands, rolls or hangs in the air not at all."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.workers.episode.start import turn
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.locomotion.slip import slipped_m
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, FACES, NODES_M
from t6gps.workers.settings import RobotSettings

RADIUS_M = RobotSettings().bar_radius_m
ROWS_N = 11


def standing() -> RobotState:
    """The neutral shape with the balls of face 0 on the plane z = 0."""
    down = NODES_M[FACES[0]].mean(axis=0)
    down /= np.linalg.norm(down)
    quaternion = np.array([*np.cross(down, [0.0, 0.0, -1.0]), 1 - down[2]])
    turned = turn(neutral_state(RobotSettings()), quaternion / np.linalg.norm(quaternion))
    return turned.but(bar_positions=turned.bar_positions + [0, 0, RADIUS_M - turned.nodes()[:, 2].min()])


def moved(start: RobotState, way: Array) -> RobotState:
    """Rows in which the robot goes `way` [3] (m) without a turn."""
    offset = np.linspace(0, 1, ROWS_N)[:, None, None] * way
    orientations = np.repeat(start.bar_orientations[None], ROWS_N, axis=0)
    still = np.zeros((ROWS_N, 6, 3))
    lengths = np.repeat(start.rest_lengths[None], ROWS_N, axis=0)
    return RobotState.of(start.bar_positions + offset, orientations, still, still, lengths)


def rolled(angle_rad: float, radius_m: float) -> RobotState:
    """Rows in which bar 0 tilts about y on its second node, a ball of `radius_m` that rolls; other bars are far up."""
    angle = np.linspace(0, angle_rad, ROWS_N)
    axis = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    foot = np.stack([radius_m * angle, 0 * angle, np.full(ROWS_N, RADIUS_M)], axis=1)
    positions = np.full((ROWS_N, 6, 3), 5.0)
    positions[:, 0] = foot + BAR_LENGTH_M / 2 * axis
    orientations = np.zeros((ROWS_N, 6, 4))
    orientations[..., 3] = 1.0
    orientations[:, 0] = np.stack([0 * angle, np.sin(angle / 2), 0 * angle, np.cos(angle / 2)], axis=1)
    still = np.zeros((ROWS_N, 6, 3))
    return RobotState.of(positions, orientations, still, still, np.ones((ROWS_N, 24)))


def faces(face: int = 0) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.full(ROWS_N, face)


@pytest.mark.parametrize("ground", [None, Terrain(np.zeros((41, 41)), 0.5)], ids=["plane", "mesh"])
def test_feet_that_are_dragged_a_metre_slip_a_metre_each(ground: Terrain | None) -> None:
    states = moved(standing(), np.array([0.6, 0.8, 0.0]))
    assert slipped_m(states, faces(), ground, RADIUS_M) == pytest.approx(3.0)


def test_nothing_slips_at_rest() -> None:
    assert slipped_m(moved(standing(), np.zeros(3)), faces(), None, RADIUS_M) == 0.0


def test_feet_in_the_air_and_nodes_that_do_not_support_do_not_slip() -> None:
    flying = standing().but(bar_positions=standing().bar_positions + [0, 0, 0.1])
    assert slipped_m(moved(flying, np.array([1.0, 0, 0])), faces(), None, RADIUS_M) == 0.0
    other = next(face for face, corners in enumerate(FACES) if not set(corners) & set(FACES[0]))
    assert slipped_m(moved(standing(), np.array([1.0, 0, 0])), faces(other), None, RADIUS_M) == 0.0


def test_a_foot_counts_only_between_rows_in_both_of_which_it_supports() -> None:
    face = faces()
    face[5:] = next(f for f, corners in enumerate(FACES) if len(set(corners) & set(FACES[0])) == 2)
    states = moved(standing(), np.array([1.0, 0.0, 0.0]))
    # Three feet for four steps; at the change, and on the new triangle, whose third node is in the air, two.
    assert slipped_m(states, face, None, RADIUS_M) == pytest.approx((3 * 4 + 2 * 6) / 10)


def test_a_ball_that_rolls_does_not_slip_and_one_that_spins_on_the_spot_does() -> None:
    face = faces(next(f for f, corners in enumerate(FACES) if 1 in corners))
    assert slipped_m(rolled(0.8, RADIUS_M), face, None, RADIUS_M) == pytest.approx(0.0, abs=1e-12)
    assert slipped_m(rolled(0.8, 0.0), face, None, RADIUS_M) == pytest.approx(0.8 * RADIUS_M)
