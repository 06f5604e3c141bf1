"""Laws of the measures of an episode: they follow from its rows, and nothing is divided by a way that there is not."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import schema
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.locomotion.energy import winch_work_j
from t6gps.workers.locomotion.measures import measures, weight_n
from t6gps.workers.robot.recorded import states
from t6gps.workers.robot.topology import BAR_LENGTH_M
from t6gps.workers.settings import RandomisationSettings, RobotSettings, RolloutSettings, TerrainSettings
from t6gps.workers.worker import RolloutWorker


def run(settings: RolloutSettings, steps: int = 60) -> Episode:
    """An episode of a policy that always wants the same, under much noise."""
    layer = (np.zeros((24, schema.OBSERVATION_N), np.float32), np.zeros(24, np.float32))
    worker = RolloutWorker(settings)
    plan = EpisodePlan(0, 0, 0, 11, 30, steps, settings.terrain.difficulty, 0.3, 0)
    episode = worker.run(plan, PolicySnapshot(0, (layer,), 1.088, 0.2))
    worker.close()
    return episode


def with_track(episode: Episode, track_m: float) -> Episode:
    """The episode with another length of its track."""
    column = episode.summary.schema.get_field_index("path_length_m")
    field = episode.summary.schema.field(column)
    return Episode(episode.frames, episode.summary.set_column(column, field, pa.array([track_m])))


def test_speed_energy_and_slip_are_those_of_the_robot_of_this_episode() -> None:
    spread = RandomisationSettings(mass_spread=0.5, stiffness_spread=0.2, winch_speed_spread=0.5)
    settings = RolloutSettings(randomisation=spread)
    episode = run(settings)
    row, found = episode.summary.to_pylist()[0], measures(episode, settings)
    robot = settings.robot.model_copy(
        update={name: row[name] for name in ("bar_mass_kg", "cable_stiffness_n_per_m", "winch_speed_m_per_s")}
    )
    assert robot != settings.robot
    assert found.speed_over_winch_speed == row["forward_speed_m_per_s"] / robot.winch_speed_m_per_s
    assert found.bar_lengths_per_s == row["forward_speed_m_per_s"] / BAR_LENGTH_M
    work_j = winch_work_j(states(episode.frames), robot)
    assert work_j > 0
    assert found.cost_of_transport == pytest.approx(work_j / (6 * robot.bar_mass_kg * 9.81 * row["path_length_m"]))
    assert weight_n(RobotSettings()) == pytest.approx(36 * 9.81)


def test_a_robot_that_gets_nowhere_has_no_cost_of_transport_and_no_slip_per_metre() -> None:
    episode = run(RolloutSettings(), steps=10)
    still, slow = (measures(with_track(episode, track_m), RolloutSettings()) for track_m in (0.0, 0.2))
    assert still.cost_of_transport is None and still.slip_per_metre is None
    assert slow.cost_of_transport is not None and slow.slip_per_metre is not None


def test_slippery_ground_lets_feet_slip_more() -> None:
    slips = []
    for friction in (0.05, 1.5):
        settings = RolloutSettings(robot=RobotSettings(friction=friction))
        slips.append(measures(run(settings), settings).slip_per_metre)
    assert slips[0] > 3 * slips[1]


def test_cables_reach_into_rough_ground_and_never_into_the_plane() -> None:
    plane, rough = (RolloutSettings(terrain=TerrainSettings(difficulty=difficulty)) for difficulty in (0.0, 1.0))
    assert measures(run(plane), plane).sunk_cable_share == 0.0
    assert measures(run(rough), rough).sunk_cable_share > 0.0
