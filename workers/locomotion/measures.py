"""What an episode's speed means: against the winches, in bar lengths, in energy, in slip, and in cables underground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from t6gps.storage import schema
from t6gps.storage.records import Episode
from t6gps.workers.ground.ground import ground
from t6gps.workers.locomotion.energy import winch_work_j
from t6gps.workers.locomotion.sinking import sunk_share
from t6gps.workers.locomotion.slip import slipped_m
from t6gps.workers.physics.engine import GRAVITY_M_PER_S2
from t6gps.workers.robot.recorded import states
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS_N
from t6gps.workers.settings import RobotSettings, RolloutSettings

SHORTEST_TRACK_M = 0.1
"""A robot that rocks on the spot goes nowhere: there is nothing to divide by."""

DRAWN = ("bar_mass_kg", "cable_stiffness_n_per_m", "friction", "winch_speed_m_per_s")
"""What the row of an episode says of its robot; the rest is configured."""


@dataclass(frozen=True, kw_only=True)
class Measures:
    """Measures of one episode; the ground track is the horizontal path of the centre of mass.

    speed_over_winch_speed   mean speed towards the waypoint, over the largest rate of a rest length
    bar_lengths_per_s        the same speed in bar lengths of 1.94 m (1/s)
    cost_of_transport        work of the winches over weight times ground track (Tucker 1975); None below 0.1 m of it
    slip_per_metre           path that feet slide, summed over them, per metre of ground track; None as above
    sunk_cable_share         share of rows 1 .. T in which a cable lies more than 2 cm below the ground
    """

    speed_over_winch_speed: float
    bar_lengths_per_s: float
    cost_of_transport: float | None
    slip_per_metre: float | None
    sunk_cable_share: float


def measures(episode: Episode, settings: RolloutSettings) -> Measures:
    """Measures of an episode that a worker with these settings ran. TerrainError where its ground cannot be made."""
    row = episode.summary.to_pylist()[0]
    robot = settings.robot.model_copy(update={name: row[name] for name in DRAWN})
    terrain = ground(settings.terrain, row["terrain_seed"], row["terrain_difficulty"])
    moved = states(episode.frames)
    face = np.asarray(schema.array(episode.frames, "face"), dtype=np.int64)
    speed, track_m = row["forward_speed_m_per_s"], row["path_length_m"]
    travelled = track_m >= SHORTEST_TRACK_M
    slid_m = slipped_m(moved, face, terrain, robot.bar_radius_m)
    return Measures(
        speed_over_winch_speed=speed / robot.winch_speed_m_per_s,
        bar_lengths_per_s=speed / BAR_LENGTH_M,
        cost_of_transport=winch_work_j(moved, robot) / (weight_n(robot) * track_m) if travelled else None,
        slip_per_metre=slid_m / track_m if travelled else None,
        sunk_cable_share=sunk_share(RobotState(moved.bars[1:], moved.rest_lengths[1:]), terrain, robot),
    )


def weight_n(robot: RobotSettings) -> float:
    """Weight of the robot (N)."""
    return BARS_N * robot.bar_mass_kg * GRAVITY_M_PER_S2
