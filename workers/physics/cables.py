"""The law of the robot's cables, in plain Python: the reference for workers/physics/bullet_hooks/native/stepper.c.

One physics step of length h: (1) the winches move, (2) the bars are read, (3) loads are computed and applied,
(4) Bullet steps. A cable between nodes a and b:

    gap, l, l'     vector from a to b, its length, its rate of change
    r, u           rest length, commanded rest length       r <- r + clip(u - r, -v h, v h)     v winch speed
    e              elastic force                            e = k max(0, l - r)
    T              tension                                  T = min(e + clip(c l', -e, e), T_max)

so that 0 <= T <= 2 e: a cable never pushes. A bar with centre x, axis n (unit) and angular velocity w feels the sum of
the pulls P1, P2 at its two nodes as the force P1 + P2 at x and the torque L/2 n x (P1 - P2) - d (w . n) n; the last
term brakes the spin about its own axis, which no cable can. Operations are ordered as in the C code, so that the two
agree to the last bit.
"""

from __future__ import annotations

import numpy as np

from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, CABLES, NODES_N
from t6gps.workers.settings import RobotSettings


def move_winches(rest_lengths: Array, command: Array, robot: RobotSettings) -> Array:
    """Rest lengths [24] (m) after one physics step towards `command` [24] (m)."""
    reach = robot.winch_speed_m_per_s * robot.physics_step_s
    return rest_lengths + np.clip(command - rest_lengths, -reach, reach)


def tensions(state: RobotState, robot: RobotSettings) -> tuple[Array, Array]:
    """Tension [24] (N) of every cable and the unit-tension pull [24, 3] on its first node."""
    positions, velocities = state.nodes(), state.node_velocities()
    gap = positions[CABLES[:, 1]] - positions[CABLES[:, 0]]
    gap_speed = velocities[CABLES[:, 1]] - velocities[CABLES[:, 0]]
    length = np.sqrt((gap * gap).sum(axis=1))
    rate = (gap * gap_speed).sum(axis=1) / length
    elastic = robot.cable_stiffness_n_per_m * np.maximum(0.0, length - state.rest_lengths)
    damping = np.clip(robot.cable_damping_n_s_per_m * rate, -elastic, elastic)
    tension = np.minimum(elastic + damping, robot.cable_max_tension_n)
    return tension, (tension / length)[:, None] * gap


def loads(state: RobotState, robot: RobotSettings) -> tuple[Array, Array]:
    """Force [6, 3] (N) at the centre and torque [6, 3] (N m) of every bar, in world axes."""
    _, pull = tensions(state, robot)
    pulls = np.zeros((NODES_N, 3))
    np.add.at(pulls, CABLES.ravel(), np.stack([pull, -pull], axis=1).reshape(-1, 3))
    first, second = pulls[BARS[:, 0]], pulls[BARS[:, 1]]
    arms = state.arms()
    axes = arms / (BAR_LENGTH_M / 2)
    spin_torque = robot.axial_damping_n_m_s * (state.bar_angular_velocities * axes).sum(axis=1)
    torques = np.cross(arms, first - second) - spin_torque[:, None] * axes
    return first + second, torques
