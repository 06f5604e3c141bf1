"""Constant tables of a decision: where numbers of a canonical robot come from, by support triangle and element.

TRANSITION [21, 25, 20] holds the element of the frame of a triangle by the triangle and the element before; -1 where
the nearest edge decides. The last row and column stand for "none before", which is written -1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.robot.support import SupportFrame, known_element
from t6gps.workers.robot.symmetry import (
    BARS_FROM,
    CABLE_MAP,
    CABLES_FROM,
    ELEMENT_BY_EDGE,
    ELEMENTS_N,
    FACE_MAP,
    NODES_FROM,
    PROPER,
    REFERENCE_FACE,
    REFERENCE_TRIANGLES_M,
)
from t6gps.workers.robot.topology import FACE_KINDS, FACES, FACES_N, LAMBDA

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def _transition() -> Ints:
    table = np.full((FACES_N + 1, ELEMENTS_N + 1, FACES_N), -1)
    for element, face in np.argwhere(REFERENCE_FACE[FACE_KINDS] == FACE_MAP).tolist():
        before = SupportFrame(face, int(FACE_KINDS[face]), element, None)
        for after in range(FACES_N):
            known = element if after == face else known_element(after, before)
            table[face, element, after] = -1 if known is None else known
    return table


INTS: Mapping[str, Ints] = {
    "faces": FACES,
    "kinds": FACE_KINDS,
    "transition": _transition(),
    "element_by_edge": ELEMENT_BY_EDGE,
    "corners_from": NODES_FROM[:, FACES[REFERENCE_FACE]],
    "nodes_from": NODES_FROM,
    "bars_from": BARS_FROM,
    "cables_from": CABLES_FROM,
    "cable_map": CABLE_MAP,
}
"""Whole numbers. `corners_from` [24, 2, 3] are the nodes of the reference triangles of both kinds."""

FLOATS: Mapping[str, Floats] = {
    "side": np.where(PROPER, 1.0, -1.0),
    "reference_triangles": REFERENCE_TRIANGLES_M,
    "barred": np.where((FACE_KINDS[:, None] == LAMBDA) & (np.arange(3) == 0), np.inf, 0.0),
}
"""Numbers. `barred` [20, 3] keeps virtual edges from being the nearest."""
