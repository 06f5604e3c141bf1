"""A control step through PyBullet's Python interface, under the law of `cables`: slow, and easy to read."""

from __future__ import annotations

from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_world import apply_loads, read_state
from t6gps.workers.physics.cables import move_winches
from t6gps.workers.physics.engine import Unique
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.settings import RobotSettings


class ReferenceStepper(Unique):
    """Steps a client as the plugin does, to the last bit."""

    def __init__(self, client: int, robot: RobotSettings, steps_n: int) -> None:
        self._client, self._robot, self._steps_n = client, robot, steps_n

    def control_step(self, bodies: list[int], rest_lengths: Array, command: Array) -> RobotState:
        """State after one control step under `command` [24] (m)."""
        for _ in range(self._steps_n):
            state = move_winches(read_state(self._client, bodies, rest_lengths), command, self._robot)
            apply_loads(self._client, bodies, state, self._robot)
            pybullet.stepSimulation(physicsClientId=self._client)
            rest_lengths = state.rest_lengths
        return read_state(self._client, bodies, rest_lengths)
