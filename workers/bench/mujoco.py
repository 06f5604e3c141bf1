"""Speed of the physics beside MuJoCo's: same robot, ground, physics step and commands, one thread, interleaved."""

from __future__ import annotations

import time

import numpy as np

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.mujoco_engine import MujocoStepper, mujoco
from t6gps.workers.physics.simulation import CONTROL_STEP_S, Simulation, neutral_state, nominal_rest_length
from t6gps.workers.robot.state import Array
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings

_STEPS_N = 10
_LARGEST_DIFFERENCE_M = 0.1


class _NativeMujoco(MujocoStepper):
    """MuJoCo with the model's own cables, as fast as it goes: Python only hands over the rest lengths of each step."""

    def __init__(self, robot: RobotSettings, terrain: Terrain | None) -> None:
        super().__init__(robot, terrain)
        self.model.opt.disableflags ^= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self._nominal_m = nominal_rest_length(robot)
        steps_n = round(CONTROL_STEP_S / robot.physics_step_s)
        self._reach = robot.winch_speed_m_per_s * robot.physics_step_s * np.arange(1, steps_n + 1)[:, None]

    def run(self, rest_lengths: Array, commands: Array) -> None:
        """Control steps under `commands` [T, 24] (m)."""
        control = self.data.ctrl[:CABLES_N]
        for command in commands:
            path = rest_lengths + np.clip(command - rest_lengths, -self._reach, self._reach)
            for offset in path - self._nominal_m:
                control[:] = offset
                mujoco.mj_step(self.model, self.data)
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
        with Simulation(robot, "plugin") as simulation:
            simulation.set_ground(terrain)
            simulation.reset(neutral_state(robot, height_m))
            for _ in range(repeats + 1):
                commands = rng.uniform(robot.shortest_command_m, robot.longest_command_m, (_STEPS_N, CABLES_N))
                start = simulation.state()
                native.place(start)
                simulation.reset(start)
                begin = time.thread_time()
                native.run(start.rest_lengths, commands)
                between = time.thread_time()
                for command in commands:
                    simulation.control_step(command)
                ratios.append((between - begin) / (time.thread_time() - between))
                gaps.append(np.linalg.norm(native.state(start.rest_lengths).com - simulation.state().com))
        if np.median(gaps) > _LARGEST_DIFFERENCE_M:
            raise PhysicsError(
                f"the engines end {np.median(gaps):.2f} m apart (median), more than {_LARGEST_DIFFERENCE_M}"
            )
        result[f"{key}_speedup_over_mujoco"] = float(np.median(ratios[1:]))  # the first round warms up
    return result
