"""The law of the robot's cables, in plain Python: the reference for workers/physics/bullet_hooks/native/stepper.c.

One physics step of length h: (1) the bars are read, (2) the winches move, (3) loads are computed and applied,
(4) Bullet steps. A cable between the attachment points a and b of two bars, which are s apart on each bar:

    gap, l, l'     vector from a to b, its length, its rate of change
    r, u           rest length, commanded rest length       r <- r + clip(u - r, -w h, v h)     v winch speed
    e              elastic force                            e = k max(0, l - r)
    T              tension                                  T = min(e + clip(c l', -e, e), T_max)
    w              speed of hauling                         w = v max(0, 1 - T / T_stall), or v without T_stall

so that 0 <= T <= 2 e: a cable never pushes. T in w is the tension before the winch moves; v of a dead winch is 0. A bar
with centre x, axis n (unit) and angular velocity w feels the sum of the pulls P1, P2 at its two ends as the force P1 +
P2 at x and the torque s/2 n x (P1 - P2) - d (w . n) n; the last term brakes the spin about its own axis, which no cable
can. Operations are ordered as in the C code, so that the two agree to the last bit.
"""

from __future__ import annotations

import numpy as np

from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BARS, CABLES, CABLES_N, NODES_N
from t6gps.workers.settings import RobotSettings


def winch_steps(robot: RobotSettings) -> Array:
    """How far each winch comes in a physics step without load [24] (m)."""
    steps = np.full(CABLES_N, robot.winch_speed_m_per_s * robot.physics_step_s)
    if robot.dead_winch is not None:
        steps[robot.dead_winch] = 0.0
    return steps


def move_winches(state: RobotState, command: Array, robot: RobotSettings) -> RobotState:
    """The state after the winches have moved for one physics step towards `command` [24] (m)."""
    hauled = reach = winch_steps(robot)
    if robot.winch_stall_n is not None:
        tension, _ = tensions(state, robot)
        hauled = reach * np.maximum(0.0, 1 - tension / robot.winch_stall_n)
    change = np.clip(command - state.rest_lengths, -hauled, reach)
    return RobotState(state.bars, state.rest_lengths + change)


def tensions(state: RobotState, robot: RobotSettings) -> tuple[Array, Array]:
    """Tension [..., 24] (N) of every cable and its pull [..., 24, 3] (N) on its first attachment point."""
    positions, velocities = (at(robot.attachment_span_m) for at in (state.nodes, state.node_velocities))
    gap = positions[..., CABLES[:, 1], :] - positions[..., CABLES[:, 0], :]
    gap_speed = velocities[..., CABLES[:, 1], :] - velocities[..., CABLES[:, 0], :]
    length = np.sqrt((gap * gap).sum(axis=-1))
    rate = (gap * gap_speed).sum(axis=-1) / length
    elastic = robot.cable_stiffness_n_per_m * np.maximum(0.0, length - state.rest_lengths)
    damping = np.clip(robot.cable_damping_n_s_per_m * rate, -elastic, elastic)
    tension = np.minimum(elastic + damping, robot.cable_max_tension_n)
    return tension, (tension / length)[..., None] * gap


def loads(state: RobotState, robot: RobotSettings) -> tuple[Array, Array]:
    """Force [6, 3] (N) at the centre and torque [6, 3] (N m) of every bar, in world axes."""
    _, pull = tensions(state, robot)
    pulls = np.zeros((NODES_N, 3))
    np.add.at(pulls, CABLES.ravel(), np.stack([pull, -pull], axis=1).reshape(-1, 3))
    first, second = pulls[BARS[:, 0]], pulls[BARS[:, 1]]
    arms = state.arms(robot.attachment_span_m)
    axes = arms / (robot.attachment_span_m / 2)
    spin_torque = robot.axial_damping_n_m_s * (state.bar_angular_velocities * axes).sum(axis=1)
    torques = np.cross(arms, first - second) - spin_torque[:, None] * axes
    return first + second, torques
