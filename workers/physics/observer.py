"""The binding of native/observer.c: what a worker computes between two control steps, at compiled speed.

`support.support_face`, `symmetry.frame_yaw`, `observation.observe` and `Terrain.height` define the same in Python; a
contract test holds both equal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.schema import NODE_SCALE_M, OBSERVATION_N, REST_LENGTH_SCALE_M
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics import _observer
from t6gps.workers.robot.observation import (
    ANGULAR_VELOCITY_SCALE_RAD_PER_S,
    FARTHEST_NODE,
    SLOWEST_TRACK_M_PER_S,
)
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame
from t6gps.workers.robot.symmetry import (
    BARS_FROM,
    CABLES_FROM,
    NODES_FROM,
    PROPER,
    REFERENCE_FACE,
    REFERENCE_TRIANGLES_M,
)
from t6gps.workers.robot.topology import BAR_LENGTH_M, CABLES_N, FACE_KINDS, FACES

_LABELS = (FACES, FACE_KINDS, REFERENCE_FACE, NODES_FROM, BARS_FROM, CABLES_FROM, PROPER)
_SCALES = (
    BAR_LENGTH_M,
    REST_LENGTH_SCALE_M,
    ANGULAR_VELOCITY_SCALE_RAD_PER_S,
    SLOWEST_TRACK_M_PER_S,
    NODE_SCALE_M,
    FARTHEST_NODE,
)
_observer.bind(
    b"".join(np.ascontiguousarray(table, dtype=np.int64).tobytes() for table in _LABELS)
    + REFERENCE_TRIANGLES_M.tobytes()
    + np.array(_SCALES).tobytes()
)


def survey(state: RobotState) -> tuple[int, float, float, float]:
    """Support face (as `support.support_face`) and centre of mass x, y, z (m) of a state."""
    return _observer.survey(state.bars)


def extremes(state: RobotState, terrain: Terrain) -> tuple[float, float]:
    """Largest |x| or |y| (m) of the nodes, and how deep the deepest lies below the ground (m; negative above it)."""
    return _observer.extremes(state.bars, terrain.heights, terrain.cell_m)


def observe(
    state: RobotState, frame: SupportFrame, target: tuple[float, float], nominal_m: float
) -> tuple[float, NDArray[np.float32]]:
    """Turn of the frame (as `symmetry.frame_yaw`, rad) and observation [83] (as `observation.observe`) of a state."""
    observation = np.empty(OBSERVATION_N, dtype=np.float32)
    yaw = _observer.observe(
        state.bars,
        state.rest_lengths,
        frame.face,
        frame.element,
        *target,
        nominal_m,
        observation,
    )
    return yaw, observation


def steer(
    mean: NDArray[np.float64], departure: NDArray[np.float64], element: int, shortest_m: float, longest_m: float
) -> NDArray[np.float64]:
    """What is commanded when a controller wants `mean` [24] (m), in canonical labels, and noise departs from it.

    Returns three rows [3, 24] (m): the mean within the range of commands; the command in world labels, as `departure`
    [24] is, within the range too; and that command in canonical labels.
    """
    rows = np.empty((3, CABLES_N))
    _observer.steer(mean, departure, element, shortest_m, longest_m, rows)
    return rows
