"""The port of an exported policy: what it measures, and how it decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t6gps.service.policies.description import Description
from t6gps.workers.robot.state import RobotState

Array = NDArray[np.float64]
State = NDArray[np.int64]
START: State = np.array([-1, -1])
"""The state before the first decision."""


@dataclass(frozen=True)
class Measurement:
    """What a robot measures before a decision, in world coordinates with z up, in the robot's own order.

    nodes                    places of the ends of the bars [12, 3] (m); nodes 2b and 2b + 1 end bar b
    com_velocity             of the centre of mass [3] (m/s)
    bar_angular_velocities   [6, 3] (rad/s), in the axes of the world
    rest_lengths             of the cables, as the winches have them now [24] (m)
    waypoint                 where to roll to [2] (m)
    """

    nodes: Array
    com_velocity: Array
    bar_angular_velocities: Array
    rest_lengths: Array
    waypoint: Array


class Driver(Protocol):
    """An exported policy, opened."""

    @property
    def description(self) -> Description:
        """What its file says of it."""

    def decide(self, measured: Measurement, state: State) -> tuple[Array, State]:
        """Rest lengths to command [24] (m) for one control period, and the state [2] for the next decision.

        Where a number that is measured is not finite, the commands are NaN and the state is that of before.
        """


def measured(state: RobotState, waypoint: tuple[float, float]) -> Measurement:
    """What is measured of a state of the simulator."""
    return Measurement(
        state.nodes(), state.com_velocity, state.bar_angular_velocities, state.rest_lengths, np.array(waypoint)
    )
