"""Laws of cables in the ground: how deep the deepest point of a line lies below the triangles, and when it counts."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.locomotion.sinking import deepest_m, sunk_share
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import RobotState
from t6gps.workers.settings import RobotSettings

ROBOT = RobotSettings()


def lowest_at(heights_m: list[float], robot: RobotSettings) -> RobotState:
    """The neutral shape once for each height of the lowest attachment point."""
    state = neutral_state(robot)
    lowest = state.nodes(robot.attachment_span_m)[:, 2].min()
    bars = np.repeat(state.bars[None], len(heights_m), axis=0)
    bars[..., 2] += np.array(heights_m)[:, None] - lowest
    return RobotState(bars, np.repeat(state.rest_lengths[None], len(heights_m), axis=0))


@pytest.mark.parametrize("ground", [None, Terrain(np.zeros((41, 41)), 0.5)], ids=["plane", "mesh"])
@pytest.mark.parametrize("span_m", [1.94, 1.65])
def test_a_cable_three_centimetres_below_the_plane_counts_and_one_of_one_does_not(
    ground: Terrain | None, span_m: float
) -> None:
    robot = RobotSettings(attachment_span_m=span_m)
    assert sunk_share(lowest_at([0.05, -0.01, -0.03, -0.1], robot), ground, robot) == 0.5


def test_a_line_over_a_ridge_is_as_deep_as_the_ridge_is_high_above_it() -> None:
    heights = np.zeros((41, 41))
    heights[20] = 0.5  # along x = 0
    first, second = np.array([-0.9, 0.13, 0.3]), np.array([0.9, 0.61, 0.34])
    assert deepest_m(first, second, Terrain(heights, 0.5)) == pytest.approx(0.5 - 0.32)


def test_no_point_of_a_line_is_deeper_than_the_deepest() -> None:
    rng, ground = np.random.default_rng(0), generate(3, 1.0)
    first = rng.uniform(-15, 15, (200, 3)) * [1, 1, 0.02]
    second = first + rng.uniform(-1.5, 1.5, (200, 3)) * [1, 1, 0.3]
    shares = np.linspace(0, 1, 2001)[:, None, None]
    points = first + shares * (second - first)
    sampled = (ground.height(points[..., 0], points[..., 1]) - points[..., 2]).max(axis=0)
    deepest = deepest_m(first, second, ground)
    assert (deepest >= sampled - 1e-12).all()
    np.testing.assert_allclose(deepest, sampled, atol=2e-3)


def test_a_line_straight_up_is_as_deep_as_its_lower_end() -> None:
    place = np.array([0.2, 0.3, -0.4])
    assert deepest_m(place, place + [0, 0, 1], Terrain(np.zeros((41, 41)), 0.5)) == pytest.approx(0.4)
