"""The robot in MuJoCo instead of PyBullet: a second opinion from an engine that shares no code with the first.

MuJoCo moves the bars of workers/physics/mjcf.py and solves their contacts. The loads on the bars are those of
workers/physics/cables.py, in place of the model's own cables, whose damping has fewer limits.
"""

from __future__ import annotations

import numpy as np

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.cables import loads, move_winches
from t6gps.workers.physics.engine import Engine, Unique
from t6gps.workers.physics.limits import check_sound, clipped, physics_steps_n
from t6gps.workers.physics.mjcf import to_mjcf
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BARS_N
from t6gps.workers.settings import RobotSettings

try:
    import mujoco
except ImportError:
    raise PhysicsError("the engine mujoco needs the package mujoco; install it: pip install 't6gps[mujoco]'") from None

__all__ = ["MujocoEngine", "MujocoStepper", "mujoco"]


class MujocoStepper(Unique):
    """A MuJoCo model of the robot on its ground, and its data, stepped under the plain law of the cables."""

    def __init__(self, robot: RobotSettings, terrain: Terrain | None) -> None:
        self._robot = robot
        self._steps_n = physics_steps_n(robot)
        self.model = mujoco.MjModel.from_xml_string(to_mjcf(robot, terrain))
        # By itself MuJoCo would put an unstable robot back to its start, unnoticed.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.data = mujoco.MjData(self.model)

    def place(self, state: RobotState) -> None:
        """Put the bars where `state` says and forget all contacts of the past."""
        mujoco.mj_resetData(self.model, self.data)
        poses, velocities = self.data.qpos.reshape(BARS_N, 7), self.data.qvel.reshape(BARS_N, 6)
        poses[:, :3] = state.bar_positions
        poses[:, 3:] = np.roll(state.bar_orientations, 1, axis=1)  # to MuJoCo's w x y z
        velocities[:, :3] = state.bar_velocities
        velocities[:, 3:] = _turned(state.bar_angular_velocities, state.bar_orientations * [-1, -1, -1, 1])

    def state(self, rest_lengths: Array) -> RobotState:
        """The present state of the bars, with these rest lengths [24] (m)."""
        poses, velocities = self.data.qpos.reshape(BARS_N, 7), self.data.qvel.reshape(BARS_N, 6)
        orientations = np.roll(poses[:, 3:], -1, axis=1)
        angular_velocities = _turned(velocities[:, 3:], orientations)  # MuJoCo has them in the axes of the bars
        return RobotState.of(poses[:, :3], orientations, velocities[:, :3], angular_velocities, rest_lengths)

    def control_step(self, rest_lengths: Array, command: Array) -> RobotState:
        """State after one control step under `command` [24] (m)."""
        for _ in range(self._steps_n):
            state = move_winches(self.state(rest_lengths), command, self._robot)
            self.data.xfrc_applied[1:] = np.hstack(loads(state, self._robot))
            mujoco.mj_step(self.model, self.data)
            rest_lengths = state.rest_lengths
        return self.state(rest_lengths)


class MujocoEngine(Engine):
    """One MuJoCo model of the robot and its ground. Raises PhysicsError if the physics cannot be started."""

    def __init__(self, robot: RobotSettings) -> None:
        self.robot = robot
        self.set_ground(None)

    def set_ground(self, terrain: Terrain | None) -> None:
        """Replace the ground, None being the plane z = 0, and put the robot into its neutral state."""
        self._terrain = terrain
        self._stepper = MujocoStepper(self.robot, terrain)
        self.reset(neutral_state(self.robot))

    def reset(self, state: RobotState) -> None:
        """Put bars and rest lengths where `state` says, and forget all contacts of the past."""
        self._stepper.place(state)
        self._state = self._stepper.state(np.array(state.rest_lengths, dtype=float))

    def state(self) -> RobotState:
        """The present state."""
        return self._state

    def control_step(self, command: Array) -> RobotState:
        """The state 0.1 s later, as `Engine.control_step` describes it."""
        within = clipped(command, self.robot)
        self._state = self._stepper.control_step(self._state.rest_lengths, within)
        check_sound(self._state, self._terrain)
        return self._state

    def close(self) -> None:
        """Do nothing: MuJoCo's memory goes with the object."""


def _turned(vectors: Array, q: Array) -> Array:
    """Vectors [n, 3] turned by the unit quaternions x y z w [n, 4]."""
    axis, w = q[:, :3], q[:, 3:]
    return np.asarray(vectors + 2 * np.cross(axis, np.cross(axis, vectors) + w * vectors))
