"""Speed of the physics beside MuJoCo's: same robot, ground, physics step and commands, one thread, interleaved."""

from __future__ import annotations

import time

import numpy as np

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.limits import physics_steps_n
from t6gps.workers.physics.mujoco_engine import MujocoStepper, mujoco
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.state import Array
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings

_STEPS_N = 10
"""Few enough that contact chaos does not part the engines."""

_LARGEST_DIFFERENCE_M = 0.1
"""Centres of mass farther apart mean that the engines did not do the same work."""


class _NativeMujoco:
    """MuJoCo with the model's own cables, as fast as it goes: Python only hands over the rest lengths of each step."""

    def __init__(self, robot: RobotSettings, terrain: Terrain | None) -> None:
        self.stepper = MujocoStepper(robot, terrain)
        self.stepper.model.opt.disableflags ^= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self._nominal_m = nominal_rest_length(robot)
        steps = np.arange(1, physics_steps_n(robot) + 1)
        self._reach = robot.winch_speed_m_per_s * robot.physics_step_s * steps[:, None]

    def run(self, rest_lengths: Array, commands: Array) -> None:
        """Control steps under `commands` [T, 24] (m)."""
        control = self.stepper.data.ctrl[:CABLES_N]
        for command in commands:
            path = rest_lengths + np.clip(command - rest_lengths, -self._reach, self._reach)
            for offset in path - self._nominal_m:
                control[:] = offset
                mujoco.mj_step(self.stepper.model, self.stepper.data)
            rest_lengths = path[-1]


def mujoco_speed(repeats: int = 40) -> dict[str, float]:
    """Medians over rounds of 10 control steps under uniformly random commands, both engines from the same state.

    flat_speedup_over_mujoco     processor time of MuJoCo over that of the plugin, above 1 where the plugin is faster
    rough_speedup_over_mujoco    the same on the paper's ground

    Raises PhysicsError if the two engines do not end near each other.
    """
    robot = RobotSettings()
    rng = np.random.default_rng(0)
    result = {}
    for key, terrain, height_m in (("flat", None, 1.07), ("rough", generate(1, 1.0), 1.8)):
        native = _NativeMujoco(robot, terrain)
        ratios, gaps = [], []
        with PyBulletEngine(robot, "plugin") as engine:
            engine.set_ground(terrain)
            engine.reset(neutral_state(robot, height_m))
            for _ in range(repeats + 1):
                commands = rng.uniform(robot.shortest_command_m, robot.longest_command_m, (_STEPS_N, CABLES_N))
                start = engine.state()
                native.stepper.place(start)
                engine.reset(start)
                begin = time.thread_time()
                native.run(start.rest_lengths, commands)
                between = time.thread_time()
                for command in commands:
                    engine.control_step(command)
                ratios.append((between - begin) / (time.thread_time() - between))
                gaps.append(np.linalg.norm(native.stepper.state(start.rest_lengths).com - engine.state().com))
        if np.median(gaps) > _LARGEST_DIFFERENCE_M:
            raise PhysicsError(
                f"the engines end {np.median(gaps):.2f} m apart (median), more than {_LARGEST_DIFFERENCE_M}"
            )
        result[f"{key}_speedup_over_mujoco"] = float(np.median(ratios[1:]))  # the first round warms up
    return result
