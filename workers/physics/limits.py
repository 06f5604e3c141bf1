"""What every engine refuses: physics steps and commands that do not fit, and states that no robot can be in."""

from __future__ import annotations

from math import isfinite

import numpy as np

from t6gps.storage.errors import PhysicsError, UnsoundStateError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.physics.observer import extremes
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, CABLES_N
from t6gps.workers.settings import RobotSettings

FASTEST_SOUND_M_PER_S = 60.0
"""Root of the summed squares of all bars' speeds: nine times the fastest sound CoM of the benchmark `soundness`."""

DEEPEST_SOUND_M = 0.3
"""Three diameters of a bar: a node that lies deeper went through the ground and does not come back."""


def physics_steps_n(robot: RobotSettings) -> int:
    """Number of physics steps in a control step. Raises PhysicsError if it is not whole."""
    steps_n = round(CONTROL_STEP_S / robot.physics_step_s)
    if abs(steps_n * robot.physics_step_s - CONTROL_STEP_S) > 1e-9:
        raise PhysicsError(
            f"robot.physics_step_s must divide the control step of {CONTROL_STEP_S} s, "
            f"got {robot.physics_step_s}; choose for instance 0.001, 0.002, 0.004 or 0.005"
        )
    return steps_n


def clipped(command: Array, robot: RobotSettings) -> Array:
    """The command [24] (m) within the robot's range of commands. Raises PhysicsError for a malformed one."""
    within = np.minimum(np.maximum(command, robot.shortest_command_m), robot.longest_command_m)
    if within.shape != (CABLES_N,) or not isfinite(within.sum()):
        raise PhysicsError(f"a command is {CABLES_N} finite rest lengths (m), got {np.asarray(command)!r}")
    return within


def check_sound(state: RobotState, terrain: Terrain | None) -> None:
    """Raise UnsoundStateError for a state that is not finite, too fast, through the ground or beyond its sides."""
    spin = BAR_LENGTH_M / 2 * state.bar_angular_velocities
    speed = np.sqrt(np.vdot(state.bar_velocities, state.bar_velocities) + np.vdot(spin, spin))
    if not speed < FASTEST_SOUND_M_PER_S:  # also true of a NaN
        raise UnsoundStateError(
            f"the six bars together move at {speed} m/s (root of the sum of squares), above "
            f"{FASTEST_SOUND_M_PER_S}: the simulation became unstable; "
            "use a smaller robot.physics_step_s or softer cables",
            reason="unstable",
        )
    if terrain is None:
        return  # the plane is a half-space: nothing passes through it
    side, depth = extremes(state, terrain)
    allowed = terrain.half_size_m
    if side > allowed:
        raise UnsoundStateError(
            f"a node is {side:.2f} m from the centre, beyond the ground's side at {allowed} m; "
            "use a larger ground or nearer waypoints",
            reason="beyond the ground",
        )
    if depth > DEEPEST_SOUND_M:
        raise UnsoundStateError(
            f"a node is {depth:.2f} m below the ground, more than {DEEPEST_SOUND_M}: a bar passed through it; "
            "use a smaller robot.physics_step_s or thicker bars",
            reason="through the ground",
        )
