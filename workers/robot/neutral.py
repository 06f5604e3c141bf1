"""The neutral shape of the robot: every cable of equal length under the pretension."""

from __future__ import annotations

from functools import cache

import numpy as np

from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, BARS_N, CABLE_LENGTH_M, CABLES_N, NODES_M
from t6gps.workers.settings import RobotSettings


def nominal_rest_length(robot: RobotSettings) -> float:
    """Rest length (m) at which every cable of the neutral shape carries the pretension."""
    return _share(robot) * CABLE_LENGTH_M - robot.pretension_n / robot.cable_stiffness_n_per_m


def _share(robot: RobotSettings) -> float:
    """Size of the icosahedron that cables and attachment points make, over the one that they make at the bars' ends."""
    return robot.attachment_span_m / BAR_LENGTH_M


@cache
def neutral_state(robot: RobotSettings, height_m: float = BAR_LENGTH_M / 2 + 0.1) -> RobotState:
    """The neutral shape at rest, as in topology.NODES_M, with its centre at height `height_m` over the origin.

    Where cables attach nearer to the middle of the bars, the bars lie nearer to each other.
    """
    first, second = NODES_M[BARS[:, 0]], NODES_M[BARS[:, 1]]
    axes = (first - second) / BAR_LENGTH_M
    # The shortest rotation from z to an axis n is the normalised quaternion (z x n, 1 + z . n); no axis is -z.
    orientations = np.stack([-axes[:, 1], axes[:, 0], np.zeros(BARS_N), 1 + axes[:, 2]], axis=1)
    state = RobotState.of(
        _share(robot) * (first + second) / 2 + [0.0, 0.0, height_m],
        orientations / np.linalg.norm(orientations, axis=1, keepdims=True),
        np.zeros((BARS_N, 3)),
        np.zeros((BARS_N, 3)),
        np.full(CABLES_N, nominal_rest_length(robot)),
    )
    for values in vars(state).values():
        values.setflags(write=False)  # every caller gets the same arrays
    return state
