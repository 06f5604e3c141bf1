"""The stretch of an episode that is looked at closely: its steepest 8 s, or on level ground the farthest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyarrow as pa

from t6gps.service.views.run_figures import Array, numbers
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import BARS_N, CABLES_N

STRETCH_STEPS_N = 80
"""Control steps from its first row to its last: a hill, and a dozen triangles that can be told apart."""


class Stretch(NamedTuple):
    """Rows first .. last of an episode, both included, and how much higher the centre of mass is at the end (m)."""

    first: int
    last: int
    gain_m: float


def stretch(frames: pa.Table, level: bool) -> Stretch:
    """Of an episode's rows the STRETCH_STEPS_N steps with the largest net height gain of the centre of mass.

    On level ground, those with the longest way as the crow flies. The whole episode where it is shorter.
    """
    height = smooth(numbers(frames, "com_z_m"))
    steps = min(STRETCH_STEPS_N, len(height) - 1)
    gain = height[steps:] - height[: len(height) - steps]
    path = track(frames)
    way = np.hypot(*(path[steps:] - path[: len(path) - steps]).T)
    first = int((way if level else gain).argmax())
    return Stretch(first, first + steps, float(gain[first]))


def smooth(heights: Array) -> Array:
    """Running means over up to five entries each way, so that neither pumping of the shape nor a bump counts."""
    sums = np.concatenate([[0.0], np.cumsum(heights)])
    here = np.arange(len(heights))
    first, last = np.maximum(here - 5, 0), np.minimum(here + 6, len(heights))
    means: Array = (sums[last] - sums[first]) / (last - first)
    return means


def track(frames: pa.Table) -> Array:
    """Centre of mass from above [T + 1, 2] (m)."""
    return np.column_stack([numbers(frames, "com_x_m"), numbers(frames, "com_y_m")])


def world_nodes(frames: pa.Table) -> Array:
    """Nodes [T + 1, 12, 3] (m) from the recorded bars."""
    positions = numbers(frames, "bar_positions").reshape(-1, BARS_N, 3)
    orientations = numbers(frames, "bar_orientations").reshape(-1, BARS_N, 4)
    still, lengths = np.zeros_like(positions), np.zeros((len(positions), CABLES_N))
    return RobotState.of(positions, orientations, still, still, lengths).nodes()
