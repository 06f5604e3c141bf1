"""The support triangle under the centre of mass and the canonical frame that follows it (paper Sec. II-B, III-A).

The frame depends on the current triangle and the one before: the edge between them becomes the reference edge. A
Lambda entered through its virtual edge leaves a mirror tie: its reference edge is then the one that meets the one
of the Lambda before, so that labels map across each edge in one way only, and one linear model can predict a crossing.
Without an adjacent triangle before, the (cable) edge nearest to the centre of mass is the reference edge. All of this
is the same in every rotated, mirrored or relabelled copy of a trajectory, so the frames are too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.symmetry import EDGE_MAP, ELEMENT_BY_EDGE
from t6gps.workers.robot.topology import DELTA, FACE_KINDS, FACES, LAMBDA, NEIGHBOR_EDGE, NEIGHBOR_FACE

Array = NDArray[np.float64]
_CORNERS = np.ascontiguousarray(FACES.T)
_SHARED_EDGE = {
    (face, int(other)): edge for face, others in enumerate(NEIGHBOR_FACE) for edge, other in enumerate(others)
}


@dataclass(frozen=True)
class SupportFrame:
    """The support triangle and its frame; they stay until the triangle changes.

    face, kind     support triangle 0 .. 19, and 0 Delta or 1 Lambda
    element        symmetry element of the frame
    entry_edge     canonical edge through which the triangle was entered, None if unknown
    """

    face: int
    kind: int
    element: int
    entry_edge: int | None


def support_face(nodes: Array, com: Array) -> int:
    """Face through which the vertical ray from the centre of mass leaves the body, the lowest if there are several.

    nodes [12, 3], com [3] (m). If the ray meets no face, the face with the lowest mean height.
    """
    x, y = nodes[:, 0] - com[0], nodes[:, 1] - com[1]
    x0, x1, x2 = x[_CORNERS]
    y0, y1, y2 = y[_CORNERS]
    # Twice the signed areas that the centre of mass spans with the edge opposite to each corner.
    areas = np.array([x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0])
    inside = np.flatnonzero((areas >= 0).all(axis=0) | (areas <= 0).all(axis=0))
    z = nodes[_CORNERS, 2]
    if len(inside):
        areas = areas[:, inside]
        heights = (areas * z[:, inside]).sum(axis=0) / areas.sum(axis=0)
        lowest = heights.argmin()
        if heights[lowest] < com[2]:
            return int(inside[lowest])
    return int(z.sum(axis=0).argmin())


def shared_edge(face: int, other: int) -> int | None:
    """Edge of `face` behind which `other` lies, None if they are not adjacent."""
    return _SHARED_EDGE.get((face, other))


def exit_edge(frame: SupportFrame, next_face: int) -> int | None:
    """Canonical edge through which `frame` is left towards `next_face`, None if they are not adjacent."""
    edge = shared_edge(frame.face, next_face)
    return None if edge is None else int(EDGE_MAP[frame.element, frame.face, edge])


def enter(face: int, previous: SupportFrame | None, state: RobotState) -> SupportFrame:
    """Frame of a support triangle that has just been entered from `previous` (None at the start of an episode)."""
    edge = None if previous is None else _entry_edge(face, previous)
    known = None if previous is None else known_element(face, previous)
    if known is None:
        known = int(ELEMENT_BY_EDGE[face, _nearest_edge(face, state.nodes(), state.com)])
    return SupportFrame(face, int(FACE_KINDS[face]), known, None if edge is None else int(EDGE_MAP[known, face, edge]))


def known_element(face: int, previous: SupportFrame) -> int | None:
    """Element of the frame of `face` after `previous`, another triangle; None where they are not adjacent."""
    edge = _entry_edge(face, previous)
    if edge is None:
        return None
    virtual = FACE_KINDS[face] == LAMBDA and edge == 0
    return int(ELEMENT_BY_EDGE[face, _meeting_edge(face, previous) if virtual else edge])


def _entry_edge(face: int, previous: SupportFrame) -> int | None:
    """Edge of `face` behind which `previous` lies, None if they are not adjacent."""
    left = shared_edge(previous.face, face)
    return None if left is None else int(NEIGHBOR_EDGE[previous.face, left])


def _meeting_edge(face: int, previous: SupportFrame) -> int:
    """Cable edge of a Lambda that meets the reference edge of the Lambda behind the virtual edge."""
    reference = int(np.flatnonzero(EDGE_MAP[previous.element, previous.face] == 1)[0])
    shared = np.intersect1d(FACES[previous.face, [reference, (reference + 1) % 3]], FACES[face])
    return 1 if shared[0] == FACES[face, 1] else 2


def _nearest_edge(face: int, nodes: Array, com: Array) -> int:
    """Edge whose line passes nearest to the centre of mass seen from above; cable edges only."""
    starts = nodes[FACES[face], :2]
    along = np.roll(starts, -1, axis=0) - starts
    offset = starts - com[:2]
    distances = np.abs(along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]) / np.hypot(*along.T)
    first = 0 if FACE_KINDS[face] == DELTA else 1
    return first + int(distances[first:].argmin())
