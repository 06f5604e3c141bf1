"""How deep cables lie in the ground, which nothing in the simulation keeps them from.

A cable is the straight line between its attachment points. Over a height field of triangles its height above the
ground is linear but for kinks, where it crosses a line of the grid or a diagonal of its cells; so the deepest point is
at a kink or an end.

    u, v     place in cells of the ground; kinks are where u, v or u - v is whole
"""

from __future__ import annotations

import numpy as np

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import CABLES
from t6gps.workers.settings import RobotSettings

SUNK_M = 0.02
"""A cable that lies deeper cuts into the ground; shallower ones may as well lie on it."""


def sunk_share(states: RobotState, ground: Terrain | None, robot: RobotSettings) -> float:
    """Share of states [n] in which a cable lies more than 2 cm below the ground."""
    ends = states.nodes(robot.attachment_span_m)[..., CABLES, :]
    return float((deepest_m(ends[..., 0, :], ends[..., 1, :], ground) > SUNK_M).any(axis=-1).mean())


def deepest_m(first: Array, second: Array, ground: Terrain | None) -> Array:
    """How deep (m) the lines between points [..., 3] lie below the ground, measured upright; negative above it."""
    if ground is None:
        return -np.minimum(first[..., 2], second[..., 2])
    shares = _kinks(first[..., :2] / ground.cell_m, second[..., :2] / ground.cell_m, (len(ground.heights) - 1) / 2)
    points = first[..., None, :] + shares[..., None] * (second - first)[..., None, :]
    depth: Array = ground.height(points[..., 0], points[..., 1]) - points[..., 2]
    return depth.max(axis=-1)


def _kinks(first: Array, second: Array, middle: float) -> Array:
    """Shares [..., k] of the ways between places [..., 2] (cells) at which lines are crossed, and both ends."""
    places = [np.concatenate([p + middle, (p[..., 0] - p[..., 1])[..., None]], axis=-1) for p in (first, second)]
    low, high = np.minimum(*places), np.maximum(*places)
    line = np.ceil(low)[..., None] + np.arange(int((np.floor(high) - np.ceil(low)).max(initial=0)) + 1)
    way = (places[1] - places[0])[..., None]
    shares = np.divide(line - places[0][..., None], way, out=np.zeros_like(line), where=way != 0)
    shares = shares.clip(0.0, 1.0).reshape(*shares.shape[:-2], -1)
    ends = np.broadcast_to([0.0, 1.0], (*shares.shape[:-1], 2))
    return np.concatenate([shares, ends], axis=-1)
