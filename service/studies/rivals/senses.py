"""What a rival sees, commands and earns, the same for all: as much as the action value of T6-GPS has.

s   observation [83], canonical velocity of the centre of mass [3] and of the nodes about it [12, 3] (m/s)
a   [24] in -1 .. 1, canonical: a rest length in the range of commands, or a rate (`command`)
r   (v*^2 - cost) / (2 v*): the speed towards the waypoint (m/s) less what is slow, sideways or up; 0 at rest
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.episode.recording import canonical_vectors
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.episode.task import running_cost
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.robot.symmetry import CABLES_FROM, NODES_FROM, world_map
from t6gps.workers.robot.topology import NODES_N
from t6gps.workers.settings import RobotSettings, TaskSettings

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

VELOCITY = slice(OBSERVATION_N, OBSERVATION_N + 3)
"""Where the velocity of the centre of mass is in s."""
SENSES_N = VELOCITY.stop + 3 * NODES_N
"""Entries of s."""


class Actions(StrEnum):
    """What the actions of a rival stand for."""

    ABSOLUTE = "absolute"
    RATES = "rates"


def senses(episode: RunningEpisode) -> Floats:
    """s [122] of an episode as it is."""
    state, element = episode.state, episode.frame.element
    world, velocity = world_map(element, episode.yaw_rad), state.com_velocity
    nodes = canonical_vectors(state.node_velocities()[None] - velocity, world[None], NODES_FROM[[element]])
    return np.concatenate([episode.observation, world @ velocity, nodes.ravel()], dtype=np.float32)


def command(actions: Actions, action: Floats, episode: RunningEpisode, robot: RobotSettings) -> Array:
    """Canonical rest lengths [24] (m), within the range of commands, that an action [24] asks for.

    A rate moves each rest length by that share of what its winch reaches in a control step.
    """
    shortest_m, longest_m = robot.shortest_command_m, robot.longest_command_m
    wide = action.astype(np.float64)
    if actions is Actions.RATES:
        present = episode.state.rest_lengths[CABLES_FROM[episode.frame.element]]
        wanted = present + robot.winch_speed_m_per_s * CONTROL_STEP_S * wide
    else:
        wanted = (longest_m + shortest_m) / 2 + (longest_m - shortest_m) / 2 * wide
    return np.clip(wanted, shortest_m, longest_m)


def reward(com_velocity: Array, direction: Array, task: TaskSettings) -> Array:
    """r [...] (m/s) of velocities [..., 3] (m/s) and the waypoint's directions [..., 2], in any common frame."""
    target = task.target_speed_m_per_s
    return (target**2 - running_cost(com_velocity, direction, task)) / (2 * target)
