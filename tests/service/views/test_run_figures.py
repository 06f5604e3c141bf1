"""Figures hold the numbers of their tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import same_color, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from t6gps.service.views import run_figures
from t6gps.storage import catalog, fields, schema
from t6gps.storage.delta import iterations
from t6gps.storage.records import Learned
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.symmetry import REFERENCE_FACE, REFERENCE_TRIANGLES_M
from t6gps.workers.robot.topology import DELTA, FACES
from t6gps.workers.settings import HALF_DIAMETER_M, RolloutSettings, TaskSettings


def _table(name: str, rows: list[dict[str, Any]]) -> pa.Table:
    """Rows of a table, zero where nothing is given."""
    zero = {
        f.name: [0.0] * (fields.vector_length(f) or 0) if pa.types.is_list(f.type) else None if f.nullable else 0
        for f in schema.TABLES[name]
    }
    zero |= {f.name: "completed" for f in schema.TABLES[name] if f.type == pa.string()}
    zero |= {f.name: False for f in schema.TABLES[name] if f.type == pa.bool_()}
    return pa.Table.from_pylist([zero | row for row in rows], schema=schema.TABLES[name])


def _nodes(com: tuple[float, float]) -> list[float]:
    """Canonical nodes of a Delta whose centre is the origin, about a centre of mass at `com`."""
    nodes = np.zeros((12, 3))
    nodes[FACES[REFERENCE_FACE[DELTA]], :2] = REFERENCE_TRIANGLES_M[DELTA]
    return list((nodes - [*com, 0.0]).ravel())


CanonicalPath = list[tuple[float, float]]
Edges = tuple[int | None, int | None]


def _episode(episode_id: int, paths: list[CanonicalPath], edges: list[Edges]) -> list[dict[str, Any]]:
    """Rows of an episode that stays on one Delta per path; the world track is x = step."""
    rows: list[dict[str, Any]] = []
    for face, (path, (entry, exit_)) in enumerate(zip(paths, edges, strict=True)):
        for number, com in enumerate(path):
            rows.append({
                "episode_id": episode_id, "step": len(rows), "face": face, "entry_edge": entry,
                "exit_edge": exit_ if number == len(path) - 1 else None, "nodes": _nodes(com),
                "com_x_m": float(len(rows)), "com_y_m": float(episode_id),
                "waypoint_x_m": 4.0 if len(rows) < 2 else 2.0, "waypoint_y_m": 3.0,
            })  # fmt: skip
    return rows


def _lines(figure: Figure, panel: int = 0) -> list[np.ndarray]:
    return [np.column_stack(line.get_data()) for line in figure.axes[panel].get_lines()]


def test_learning_curves_hold_means_and_standard_errors() -> None:
    rows = [
        {"iteration": i, "cost": 1 - 0.1 * i, "cost_standard_error": 0.05, "forward_speed_m_per_s": 0.2 * i,
         "forward_speed_standard_error": 0.03, "stuck_share_by_distance": 0.5 / (i + 1)}
        for i in range(4)
    ]  # fmt: skip
    figure = run_figures.learning(_table("iterations", rows))
    for panel, (name, scale) in enumerate(
        (("cost", 1), ("forward_speed_m_per_s", 1), ("stuck_share_by_distance", 100))
    ):
        expected = [(row["iteration"], scale * row[name]) for row in rows]
        np.testing.assert_allclose(_lines(figure, panel)[0], expected)
    band = figure.axes[0].collections[0].get_paths()[0].vertices
    assert np.ptp(band[band[:, 0] == 2, 1]) == pytest.approx(0.1)


@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_the_ground_track_shows_the_episode_of_median_speed(difficulty: float) -> None:
    paths = [[(0.0, 0.0)] * 5]
    frames = _table("frames", [row for i in range(3) for row in _episode(i, paths, [(None, None)])])
    speeds = (0.9, 0.1, 0.4)
    summary = [
        {"episode_id": i, "forward_speed_m_per_s": speed, "terrain_difficulty": difficulty, "terrain_seed": i % 2}
        for i, speed in enumerate(speeds)
    ]
    settings = RolloutSettings(task=TaskSettings(waypoint_radius_m=0.3))
    figure = run_figures.ground_track(frames, _table("episodes", summary), settings)
    tracks = [line for line in _lines(figure) if len(line) == 5]
    drawn = {int(track[0, 1]) for track in tracks}
    assert drawn == ({0, 1, 2} if difficulty == 0 else {0, 2}), "others only on the same ground"
    np.testing.assert_array_equal(tracks[-1], [(step, 2.0) for step in range(5)])
    circles = [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]
    assert [circle.center for circle in circles] == [(0, 2), (4, 3), (2, 3)]
    assert [circle.radius for circle in circles] == [HALF_DIAMETER_M, 0.3, 0.3]


def test_ground_that_is_level_where_the_robot_went_has_no_contours() -> None:
    terrain, low, high = Terrain(np.diag(np.full(21, 1.0)), 0.5), np.array([-4.0, 2.0]), np.array([-2.0, 4.0])
    figure = Figure()
    axes = figure.subplots()
    run_figures.contours(figure, axes, terrain, low, high)
    assert not axes.collections
    run_figures.contours(figure, axes, terrain, low, -low)
    assert axes.collections


def test_segments_are_drawn_about_the_centre_of_their_triangle_in_the_colour_of_their_class() -> None:
    paths = [[(-0.3, 0.0), (0.1, 0.1)], [(-0.3, 0.1), (0.0, 0.0), (0.1, -0.2)], [(-0.2, 0.0), (0.0, 0.0)]]
    frames = _table("frames", _episode(7, paths, [(0, 1), (0, 2), (0, None)]))
    complete = [{"entry_edge": 0, "exit_edge": e, "segments": 10 + e} for e in (2, 1)]
    rest = [{"entry_edge": 0, "segments": 3}, {"entry_edge": 0, "exit_edge": 1, "truncated": True, "segments": 4}]
    classes = _table("classes", complete + rest)
    figure = run_figures.segments(frames, classes)
    drawn = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    assert len(drawn) == 2, "a partial segment has no class colour"
    for collection, path, colour in zip(drawn, paths, (run_figures.BLUE, run_figures.ORANGE), strict=False):
        np.testing.assert_allclose(collection.get_segments()[0], path, atol=1e-6)
        assert same_color(to_rgb(collection.get_colors()[0]), colour)
    bars = figure.axes[2].patches
    assert [bar.get_width() for bar in bars] == [11, 12, 7]
    assert [label.get_text() for label in figure.axes[2].get_yticklabels()] == [
        "Delta  back → left",
        "Delta  back → right",
        "Delta  partial or cut",
    ]


def test_paths_of_two_episodes_are_not_joined() -> None:
    path = [(0.0, 0.0), (0.1, 0.0)]
    rows = _episode(1, [path], [(0, 1)]) + _episode(2, [path], [(0, 1)])
    figure = run_figures.segments(_table("frames", rows), _table("classes", []))
    assert [len(path) for path in figure.axes[0].collections[0].get_segments()] == [2, 2]


def test_a_run_without_iterations_has_no_figures(tmp_path: Path) -> None:
    assert run_figures.draw(catalog.create(tmp_path, "run", "{}"), RolloutSettings()) == []


def test_figures_show_the_last_iteration_and_are_written_whole(tmp_path: Path, make_episode: Any) -> None:
    run = catalog.create(tmp_path, "run", "{}")
    for iteration in range(2):
        row = _table("iterations", [{"iteration": iteration}]).to_pylist()[0]
        classes = _table("classes", [{"iteration": iteration, "segments": 3}]).to_pylist()
        episodes = [_sound(make_episode(iteration, iteration), iteration)]
        iterations.commit(run, iteration, episodes, Learned(row, classes, schema.MODELS.empty_table(), []))
    drawn = run_figures.draw(run, RolloutSettings())
    assert drawn == [run.figures / f"{name}.png" for name in ("learning", "ground_track", "segments")]
    assert sorted(run.figures.iterdir()) == sorted(drawn)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)


def _sound(episode: Any, iteration: int) -> Any:
    """The episode with rows that mean something."""
    rows = _table("frames", _episode(iteration, [[(0.0, 0.0)] * 6], [(None, None)]))
    summary = [{"episode_id": iteration, "iteration": iteration, "steps": 5}]
    random = ("iteration", "policy_version", "action", "action_mean")
    columns = [(episode.frames if name in random else rows).column(name) for name in rows.column_names]
    frames = pa.table(columns, schema=schema.FRAMES)
    return type(episode)(frames, _table("episodes", summary))
