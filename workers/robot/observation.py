"""What a policy may see, scaled to order one: the symmetry-reduced sensor data (paper Sec. IV-C), then the shape.

entry      meaning                                                         scale
0          kind of the support triangle: 0 Delta, 1 Lambda                 1
1 .. 24    canonical rest lengths about the nominal one                    0.2 m
25 .. 42   canonical angular velocities of the bars [6, 3]                 2 rad/s
43, 44     target direction: cosine and sine in the canonical frame        1
45, 46     track direction: horizontal CoM velocity over max(norm, 0.05 m/s), so that it fades at rest
47 .. 82   canonical nodes about the centre of mass [12, 3], within +-4       0.5 m

The paper's policy sees the first 47 (`learner.observation = sensors`).
"""

from __future__ import annotations

from math import cos, hypot, sin

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.schema import NODE_SCALE_M, OBSERVATION_N, REST_LENGTH_SCALE_M, SENSORS_N
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame
from t6gps.workers.robot.symmetry import BARS_FROM, CABLES_FROM, NODES_FROM, PROPER, world_map

ANGULAR_VELOCITY_SCALE_RAD_PER_S = 2.0
"""The unit of angular velocities."""

SLOWEST_TRACK_M_PER_S = 0.05
"""Below this speed of the centre of mass its direction means little, and fades."""

FARTHEST_NODE = 4.0
"""In that unit: 2 m from the centre of mass, where nodes never are."""


def observe(
    state: RobotState, frame: SupportFrame, yaw_rad: float, target: NDArray[np.float64], nominal_m: float
) -> NDArray[np.float32]:
    """Observation [83] of a state; `target` [2] is the horizontal unit vector to the waypoint in the world."""
    side = 1.0 if PROPER[frame.element] else -1.0
    c, s = cos(yaw_rad), sin(yaw_rad)
    observation = np.empty(OBSERVATION_N, dtype=np.float32)
    observation[0] = frame.kind
    observation[1:25] = (state.rest_lengths[CABLES_FROM[frame.element]] - nominal_m) / REST_LENGTH_SCALE_M
    # Angular velocity is a pseudo-vector: a mirror maps it by det(W) W.
    x, y, z = state.bar_angular_velocities[BARS_FROM[frame.element]].T / ANGULAR_VELOCITY_SCALE_RAD_PER_S
    observation[25:43:3] = side * c * x - s * y
    observation[26:43:3] = side * s * x + c * y
    observation[27:43:3] = side * z
    vx, vy, _ = state.com_velocity
    norm = max(hypot(vx, vy), SLOWEST_TRACK_M_PER_S)
    for first, (along_x, along_y) in ((43, target), (45, (vx / norm, vy / norm))):
        observation[first] = c * along_x - s * side * along_y
        observation[first + 1] = s * along_x + c * side * along_y
    nodes = (state.nodes() - state.com)[NODES_FROM[frame.element]] / NODE_SCALE_M
    canonical = (nodes @ world_map(frame.element, yaw_rad).T).ravel()
    observation[SENSORS_N:] = canonical.clip(-FARTHEST_NODE, FARTHEST_NODE)
    return observation
