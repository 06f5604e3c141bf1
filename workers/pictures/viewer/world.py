"""What an episode's tables do not hold and its pictures need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.settings import RobotSettings

Array = NDArray[np.float64]

BRIGHTEST_PER_PRETENSION = 4.0
"""Where the colours of tensions end; of a trained robot's on rough ground, 99 % lie below."""


@dataclass(frozen=True)
class World:
    """The robot of an episode, its ground (None: flat) and the radius of a waypoint (m)."""

    robot: RobotSettings
    terrain: Terrain | None
    waypoint_radius_m: float

    def height(self, x: Array, y: Array) -> Array:
        """Height of the ground (m)."""
        return np.zeros(np.shape(x)) if self.terrain is None else self.terrain.height(x, y)

    @property
    def brightest_n(self) -> float:
        """Tension from which on a cable is drawn in the last colour (N)."""
        return BRIGHTEST_PER_PRETENSION * self.robot.pretension_n
