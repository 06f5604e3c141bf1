"""The state of the robot in world coordinates, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.topology import BAR_LENGTH_M, NODES_N

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobotState:
    """Six rigid bars and the rest lengths of 24 cables (paper Sec. II-B). A bar's own z axis points to its first node.

    All arrays may carry the same leading axes, time for instance.

    bar_positions            centres [..., 6, 3] (m)
    bar_orientations         unit quaternions x y z w [..., 6, 4]
    bar_velocities           velocities of the centres [..., 6, 3] (m/s)
    bar_angular_velocities   in world axes [..., 6, 3] (rad/s)
    rest_lengths             [..., 24] (m)
    """

    bar_positions: Array
    bar_orientations: Array
    bar_velocities: Array
    bar_angular_velocities: Array
    rest_lengths: Array

    @property
    def com(self) -> Array:
        """Centre of mass [..., 3] (m); all bars weigh the same."""
        return self.bar_positions.sum(axis=-2) / 6

    @property
    def com_velocity(self) -> Array:
        """Velocity of the centre of mass [..., 3] (m/s)."""
        return self.bar_velocities.sum(axis=-2) / 6

    def nodes(self) -> Array:
        """Positions of the nodes [..., 12, 3] (m); the nodes 2b and 2b + 1 end bar b."""
        return _at_both_ends(self.bar_positions, self.arms())

    def node_velocities(self) -> Array:
        """Velocities of the nodes [..., 12, 3] (m/s)."""
        return _at_both_ends(self.bar_velocities, np.cross(self.bar_angular_velocities, self.arms()))

    def arms(self) -> Array:
        """From each bar's centre to its first node [..., 6, 3] (m)."""
        x, y, z, w = (self.bar_orientations[..., i] for i in range(4))
        axes = np.empty_like(self.bar_positions)
        axes[..., 0] = x * z + w * y
        axes[..., 1] = y * z - w * x
        axes[..., 2] = 0.5 - x * x - y * y
        axes *= BAR_LENGTH_M
        return axes


def _at_both_ends(centres: Array, arms: Array) -> Array:
    ends = np.empty((*centres.shape[:-2], NODES_N, 3))
    ends[..., 0::2, :] = centres + arms
    ends[..., 1::2, :] = centres - arms
    return ends
