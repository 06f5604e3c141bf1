"""How far feet slide, from states ten times a second.

A foot is an end of a bar: a ball of the bar's radius around a node, on a corner of the support triangle and in contact
with the ground. Between two rows

    d        way of its node                                x    turn of its bar, axis times angle
    n        normal of the ground below it                  a    radius of the bar

the point in contact slides by d - a x x n: a foot that rolls does not slip. A foot counts between two rows when it is
one in both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.state import Array, RobotState, cross
from t6gps.workers.robot.topology import FACES, NODES_N

CONTACT_GAP_M = 0.005
"""A ball this far above the ground touches it: Bullet lets bodies hover and sink by a millimetre or two."""


def slipped_m(states: RobotState, face: NDArray[np.int64], ground: Terrain | None, bar_radius_m: float) -> float:
    """Horizontal path (m) that all feet together slide along states [T + 1] on the support triangles `face` [T + 1]."""
    nodes = states.nodes()
    height, normal = _below(nodes, ground)
    touches = (nodes[..., 2] - height) * normal[..., 2] <= bar_radius_m + CONTACT_GAP_M
    foot = touches & (np.arange(NODES_N) == FACES[face][..., None]).any(axis=1)
    turn = np.repeat(_turns(states.bar_orientations), 2, axis=1)
    rolled = bar_radius_m * cross(turn, (normal[:-1] + normal[1:]) / 2)
    slid = np.linalg.norm((np.diff(nodes, axis=0) - rolled)[..., :2], axis=-1)
    return float(slid[foot[:-1] & foot[1:]].sum())


def _below(points: Array, ground: Terrain | None) -> tuple[Array, Array]:
    """Height (m) and normal of the ground below points [..., 3]."""
    if ground is None:
        return np.zeros(points.shape[:-1]), np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    x, y = points[..., 0], points[..., 1]
    return ground.height(x, y), ground.normal(x, y)


def _turns(orientations: Array) -> Array:
    """Axis times angle [T, n, 3] (rad) of the turns between unit quaternions x y z w [T + 1, n, 4]."""
    before, after = orientations[:-1], orientations[1:]
    a, b = before[..., :3], after[..., :3]
    v, w = before[..., 3:], after[..., 3:]
    axis = v * b - w * a + cross(a, b)
    cosine = v * w + (a * b).sum(axis=-1, keepdims=True)
    axis, cosine = np.where(cosine < 0, -axis, axis), np.abs(cosine)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    return 2 * axis * np.divide(np.arctan2(sine, cosine), sine, out=np.ones_like(sine), where=sine > 0)
