"""What an episode's frames say of the robot in world coordinates, cable by cable and node by node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.records import Episode
from t6gps.workers.physics.cables import tensions
from t6gps.workers.robot.recorded import in_order, states
from t6gps.workers.settings import RobotSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """T + 1 rows of an episode, the robot's cables and nodes in their own order whatever the support triangle.

    com            centre of mass [T + 1, 3] (m)
    nodes          ends of the bars [T + 1, 12, 3] (m)
    attached       where cables attach near those ends [T + 1, 12, 3] (m)
    rest_lengths   of the cables [T + 1, 24] (m)
    commands       commanded rest lengths, for rows with an action [T, 24] (m)
    tensions       of the cables, by the law of the simulation [T + 1, 24] (N)
    """

    com: Array
    nodes: Array
    attached: Array
    rest_lengths: Array
    commands: Array
    tensions: Array


def motion(frames: pa.Table, robot: RobotSettings) -> Motion:
    """The motion of an episode's robot, which `robot` describes, from its frames."""
    state = states(frames)
    return Motion(
        com=state.com,
        nodes=state.nodes(),
        attached=state.nodes(robot.attachment_span_m),
        rest_lengths=state.rest_lengths,
        commands=in_order(frames, "action"),
        tensions=tensions(state, robot)[0],
    )


def of_episode(episode: Episode, robot: RobotSettings) -> Motion:
    """The motion of an episode whose robot `robot` describes, but for the stiffness that was perhaps drawn for it."""
    drawn = {"cable_stiffness_n_per_m": episode.summary["cable_stiffness_n_per_m"][0].as_py()}
    return motion(episode.frames, robot.model_copy(update=drawn))
