"""Laws of what a page draws: the robot stands where the frames have it, on the ground that it walked on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from rough_walk import walked

from t6gps.service import config as configuration
from t6gps.service.views import replay
from t6gps.service.views.replay import Replay
from t6gps.storage import catalog
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode
from t6gps.storage.spool import Spool
from t6gps.workers.ground.ground import ground
from t6gps.workers.pictures.motion import of_episode
from t6gps.workers.pictures.stays import stuck

CONFIG = configuration.load("rough-quick", ["task.waypoint_timeout_s=1.5"])


@pytest.fixture(scope="module")
def episode() -> Episode:
    """A real one on rough ground, with another waypoint every 1.5 s."""
    return walked(CONFIG.rollout)


@pytest.fixture(scope="module")
def shown(episode: Episode) -> Replay:
    return replay.replay("walk", CONFIG, episode, None)


def numbers(values: list[float], *shape: int) -> NDArray[np.float64]:
    return np.array(values).reshape(-1, *shape)


def test_nodes_and_tensions_are_those_of_the_frames_but_for_the_rounding(episode: Episode, shown: Replay) -> None:
    moved = of_episode(episode, CONFIG.robot)
    np.testing.assert_allclose(numbers(shown.nodes_m, 12, 3), moved.nodes, atol=5.1e-5)
    np.testing.assert_allclose(numbers(shown.com_m, 3), moved.com, atol=5.1e-5)
    np.testing.assert_allclose(numbers(shown.tensions_n, 24), moved.tensions, atol=0.051)
    assert shown.time_s == pytest.approx(episode.frames["time_s"].to_pylist(), abs=1e-4)
    assert shown.face == episode.frames["face"].to_pylist()


def test_the_ground_around_the_path_is_the_episodes_own(shown: Replay) -> None:
    terrain, patch = ground(CONFIG.terrain, 5, 0.7), shown.ground
    assert terrain is not None
    assert patch is not None
    x = patch.x_m + patch.cell_m * np.arange(patch.rows)
    y = patch.y_m + patch.cell_m * np.arange(patch.columns)
    heights = numbers(patch.heights_m, patch.columns)
    np.testing.assert_allclose(heights, terrain.height(*np.meshgrid(x, y, indexing="ij")), atol=5.1e-5)
    path = numbers(shown.com_m, 3)[:, :2]
    sides = np.array([[x[0], y[0]], [x[-1], y[-1]]])
    reached = np.abs(sides[:, None] - path).min(axis=1) >= 5.9
    at_the_end = np.abs(np.abs(sides) - terrain.half_size_m) < 1e-9
    assert (reached | at_the_end).all()


def test_episodes_have_one_ground_where_their_seeds_have(episode: Episode, shown: Replay) -> None:
    other = episode.summary.set_column(
        episode.summary.schema.get_field_index("terrain_seed"), "terrain_seed", pa.array([6], pa.int64())
    )
    assert replay.replay("walk", CONFIG, replace(episode, summary=other), None).ground_id != shown.ground_id
    flat = configuration.load("flat-quick")
    assert replay.replay("walk", flat, _flat(episode), None).ground_id == "plane"


def test_spans_cover_each_row_once_and_say_where_the_robot_is_stuck(episode: Episode, shown: Replay) -> None:
    covered = [row for span in shown.segments for row in range(span.start, span.stop)]
    assert covered == list(range(len(shown.time_s)))
    held = stuck(of_episode(episode, CONFIG.robot).com)
    assert [row for start, stop in shown.stuck for row in range(start, stop)] == np.flatnonzero(held).tolist()
    places = [(mark.x_m, mark.y_m) for mark in shown.waypoints]
    assert len(places) > 2
    assert places[0] == pytest.approx(
        (episode.frames["waypoint_x_m"][0].as_py(), episode.frames["waypoint_y_m"][0].as_py()), abs=1e-4
    )


def test_the_newest_episode_is_the_last_one_that_waits_for_its_iteration(tmp_path: Path, episode: Episode) -> None:
    run = catalog.create(tmp_path, "walk", CONFIG.to_json())
    with pytest.raises(DataError, match="no episode yet"):
        replay.of_newest(run)
    Spool(run.spool, 0).append(episode)
    assert replay.of_newest(run).episode == 7


@pytest.mark.parametrize("column", ["face", "element", "entry_edge"])
def test_numbers_that_no_robot_has_are_one_error(episode: Episode, column: str) -> None:
    place = episode.frames.schema.get_field_index(column)
    kind = episode.frames.schema.field(column)
    wrong = episode.frames.set_column(place, kind, pa.array([99] * len(episode.frames), kind.type))
    with pytest.raises(DataError, match="t6gps verify walk"):
        replay.replay("walk", CONFIG, replace(episode, frames=wrong), None)


def test_random_numbers_are_one_error(make_episode: Callable[..., Episode]) -> None:
    with pytest.raises(DataError, match="no robot has"):
        replay.replay("walk", configuration.load("flat-quick"), make_episode(0, 0), None)


def _flat(episode: Episode) -> Episode:
    place = episode.summary.schema.get_field_index("terrain_difficulty")
    return replace(episode, summary=episode.summary.set_column(place, "terrain_difficulty", pa.array([0.0])))
