"""The state of the robot in world coordinates, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.robot.topology import BAR_LENGTH_M, NODES_N

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobotState:
    """Six rigid bars and the rest lengths of 24 cables (paper Sec. II-B). A bar's own z axis points to its first node.

    All arrays may carry the same leading axes, time for instance.

    bars                     per bar [..., 6, 13] what follows, side by side
    bar_positions            centres [..., 6, 3] (m)
    bar_orientations         unit quaternions x y z w [..., 6, 4]
    bar_velocities           velocities of the centres [..., 6, 3] (m/s)
    bar_angular_velocities   in world axes [..., 6, 3] (rad/s)
    rest_lengths             [..., 24] (m)
    """

    bars: Array
    rest_lengths: Array

    @classmethod
    def of(
        cls,
        bar_positions: Array,
        bar_orientations: Array,
        bar_velocities: Array,
        bar_angular_velocities: Array,
        rest_lengths: Array,
    ) -> Self:
        """The state with these parts."""
        parts = (bar_positions, bar_orientations, bar_velocities, bar_angular_velocities)
        return cls(np.concatenate(parts, axis=-1), rest_lengths)

    def but(self, **parts: Array) -> RobotState:
        """This state with other `parts`, named as the arguments of `of`."""
        return RobotState.of(**(self.parts() | parts))

    def parts(self) -> dict[str, Array]:
        """The arguments of `of` by name."""
        names = ("bar_positions", "bar_orientations", "bar_velocities", "bar_angular_velocities", "rest_lengths")
        return {name: getattr(self, name) for name in names}

    @property
    def bar_positions(self) -> Array:
        return self.bars[..., :3]

    @property
    def bar_orientations(self) -> Array:
        return self.bars[..., 3:7]

    @property
    def bar_velocities(self) -> Array:
        return self.bars[..., 7:10]

    @property
    def bar_angular_velocities(self) -> Array:
        return self.bars[..., 10:]

    @property
    def com(self) -> Array:
        """Centre of mass [..., 3] (m); all bars weigh the same."""
        return self.bar_positions.sum(axis=-2) / 6

    @property
    def com_velocity(self) -> Array:
        """Velocity of the centre of mass [..., 3] (m/s)."""
        return self.bar_velocities.sum(axis=-2) / 6

    def nodes(self, span_m: float = BAR_LENGTH_M) -> Array:
        """Positions of the nodes [..., 12, 3] (m); the nodes 2b and 2b + 1 end bar b.

        With `span_m`, of the points so far apart on each bar, where cables attach for instance.
        """
        return _at_both_ends(self.bar_positions, self.arms(span_m))

    def node_velocities(self, span_m: float = BAR_LENGTH_M) -> Array:
        """Velocities of the same points [..., 12, 3] (m/s)."""
        return _at_both_ends(self.bar_velocities, cross(self.bar_angular_velocities, self.arms(span_m)))

    def arms(self, span_m: float = BAR_LENGTH_M) -> Array:
        """From each bar's centre to the first of these points [..., 6, 3] (m)."""
        x, y, z, w = (self.bar_orientations[..., i] for i in range(4))
        axes = np.empty_like(self.bar_positions)
        axes[..., 0] = x * z + w * y
        axes[..., 1] = y * z - w * x
        axes[..., 2] = 0.5 - x * x - y * y
        axes *= span_m
        return axes


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors [..., 3], several times faster than numpy.cross for few of them."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def _at_both_ends(centres: Array, arms: Array) -> Array:
    ends = np.empty((*centres.shape[:-2], NODES_N, 3))
    ends[..., 0::2, :] = centres + arms
    ends[..., 1::2, :] = centres - arms
    return ends
