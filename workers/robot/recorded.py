"""The robot's states as the frames of an episode hold them, in world coordinates and the cables' own order."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.symmetry import CABLE_MAP
from t6gps.workers.robot.topology import BARS_N, CABLES_N

Array = NDArray[np.float64]

BARS = ("bar_positions", "bar_orientations", "bar_velocities", "bar_angular_velocities")
"""Columns of the parts of `RobotState.bars`, side by side."""


def states(frames: pa.Table) -> RobotState:
    """The states of all rows [T + 1] of an episode, rounded to float32 as the table has them."""
    bars = [numbers(frames, name).reshape(frames.num_rows, BARS_N, -1) for name in BARS]
    return RobotState(np.concatenate(bars, axis=-1), in_order(frames, "rest_lengths"))


def in_order(frames: pa.Table, name: str) -> Array:
    """A canonical column of cables, such as `action`, in the cables' own order [rows that have one, 24]."""
    values = numbers(frames, name).reshape(-1, CABLES_N)
    cable_of = CABLE_MAP[schema.array(frames, "element")][: len(values)]
    return np.take_along_axis(values, cable_of, axis=1)


def numbers(frames: pa.Table, name: str) -> Array:
    """A column without its nulls, as 64-bit floats."""
    return np.asarray(schema.array(frames, name), dtype=np.float64)
