"""What an episode's frames say of the robot in world coordinates, cable by cable and node by node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.storage.records import Episode
from t6gps.workers.physics.cables import tensions
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.symmetry import CABLE_MAP
from t6gps.workers.robot.topology import BARS_N, CABLES_N
from t6gps.workers.settings import RobotSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """T + 1 rows of an episode, the robot's cables and nodes in their own order whatever the support triangle.

    com            centre of mass [T + 1, 3] (m)
    nodes          ends of the bars [T + 1, 12, 3] (m)
    rest_lengths   of the cables [T + 1, 24] (m)
    commands       commanded rest lengths, for rows with an action [T, 24] (m)
    tensions       of the cables, by the law of the simulation [T + 1, 24] (N)
    """

    com: Array
    nodes: Array
    rest_lengths: Array
    commands: Array
    tensions: Array


def motion(frames: pa.Table, robot: RobotSettings) -> Motion:
    """The motion of an episode's robot, which `robot` describes, from its frames."""
    cable_of = CABLE_MAP[schema.array(frames, "element")]
    parts = (("positions", 3), ("orientations", 4), ("velocities", 3), ("angular_velocities", 3))
    bars = [numbers(frames, f"bar_{part}").reshape(-1, BARS_N, n) for part, n in parts]
    rest_lengths = np.take_along_axis(numbers(frames, "rest_lengths").reshape(-1, CABLES_N), cable_of, axis=1)
    state = RobotState(np.concatenate(bars, axis=-1), rest_lengths)
    actions = numbers(frames, "action").reshape(-1, CABLES_N)
    rows = (RobotState(*row) for row in zip(state.bars, state.rest_lengths, strict=True))
    return Motion(
        com=state.com,
        nodes=state.nodes(),
        rest_lengths=state.rest_lengths,
        commands=np.take_along_axis(actions, cable_of[: len(actions)], axis=1),
        tensions=np.array([tensions(row, robot)[0] for row in rows]),
    )


def of_episode(episode: Episode, robot: RobotSettings) -> Motion:
    """The motion of an episode whose robot `robot` describes, but for the stiffness that was perhaps drawn for it."""
    drawn = {"cable_stiffness_n_per_m": episode.summary["cable_stiffness_n_per_m"][0].as_py()}
    return motion(episode.frames, robot.model_copy(update=drawn))


def numbers(frames: pa.Table, name: str) -> Array:
    """A column without its nulls, as 64-bit floats."""
    return np.asarray(schema.array(frames, name), dtype=np.float64)
