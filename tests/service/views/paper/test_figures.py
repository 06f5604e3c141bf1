"""The paper's figures show what is in the tables."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.lines import Line2D

from t6gps.service.views.paper import drawing, speeds
from t6gps.service.views.paper.costs import costs
from t6gps.service.views.paper.footprints import clearance, stays
from t6gps.service.views.paper.material import Material
from t6gps.service.views.paper.models import bins
from t6gps.service.views.paper.stretch import STRETCH_STEPS_N, Stretch, smooth, stretch
from t6gps.workers.ground.terrain import Terrain


def walk(height_m: np.ndarray, x_m: np.ndarray) -> pa.Table:
    return pa.table({"com_x_m": x_m, "com_y_m": np.zeros(len(x_m)), "com_z_m": height_m})


def points(line: Line2D) -> np.ndarray:
    return np.column_stack([np.asarray(values, dtype=float) for values in line.get_data()])


def test_costs_are_those_of_the_iterations_and_of_the_evaluation(material: Material) -> None:
    left, right = costs(material).axes
    rows, evaluation = material.iterations.to_pylist(), material.evaluation.to_pylist()[0]
    sampled, noise_free = (container.lines[0] for container in left.containers)
    np.testing.assert_allclose(points(sampled), [(row["policy_version"], row["cost"]) for row in rows])
    np.testing.assert_allclose(points(noise_free), [(evaluation["policy_version"], evaluation["cost"])])
    promised = next(line for line in right.get_lines() if "promised" in str(line.get_label()))
    np.testing.assert_allclose(points(promised), [(row["iteration"] + 1, row["predicted_cost_change"]) for row in rows])


def test_the_ground_track_starts_and_ends_where_the_frames_do(material: Material) -> None:
    axes = drawing.FIGURES["ground_track"](material).axes[0]
    track = points(max(axes.get_lines(), key=lambda line: len(points(line))))
    frames = material.shown.frames
    assert len(track) == frames.num_rows
    for row in (0, -1):
        assert tuple(track[row]) == (frames["com_x_m"][row].as_py(), frames["com_y_m"][row].as_py())


def test_bins_hold_every_model_and_every_sample(material: Material) -> None:
    rows = material.models.to_pylist()
    found = bins(material.models)
    assert sum(float(np.nansum(each.modes)) for each in found) == len(rows)
    first = Counter[int]()
    for row in rows:
        first[row["bin"]] += row["samples"] * (row["step"] == 0)
    assert [each.samples for each in found] == sorted(first.values(), reverse=True)
    means = {
        (row["bin"], row["step"]): np.average(
            [r["residual"] for r in same if r["samples"]], weights=[r["samples"] for r in same if r["samples"]]
        )
        for row in rows
        if (same := [r for r in rows if (r["bin"], r["step"]) == (row["bin"], row["step"])])
        and any(r["samples"] for r in same)
    }
    drawn = np.concatenate([each.residual[np.isfinite(each.residual)] for each in found])
    np.testing.assert_allclose(np.sort(drawn), np.sort(list(means.values())), rtol=1e-9)


def test_a_run_without_models_has_all_figures_but_that_of_the_models(material: Material) -> None:
    assert not drawing.lacking(material)
    lacking = drawing.lacking(replace(material, models=material.models.slice(0, 0)))
    assert lacking.keys() == {"models"} < drawing.FIGURES.keys()


def test_the_stretch_is_the_one_with_the_largest_gain_of_height() -> None:
    height = np.random.default_rng(0).normal(size=400).cumsum() * 0.05
    found = stretch(walk(height, np.zeros(400)), level=False)
    mean = [height[max(row - 5, 0) : row + 6].mean() for row in range(400)]
    gains = [mean[row + STRETCH_STEPS_N] - mean[row] for row in range(400 - STRETCH_STEPS_N)]
    assert found[:2] == (int(np.argmax(gains)), int(np.argmax(gains)) + STRETCH_STEPS_N)
    assert found.gain_m == pytest.approx(max(gains))
    np.testing.assert_allclose(smooth(height), mean)


def test_on_level_ground_the_stretch_is_the_farthest() -> None:
    speed = np.where((np.arange(400) >= 150) & (np.arange(400) < 230), 1.0, 0.1)
    assert stretch(walk(np.ones(400), speed.cumsum()), level=True)[:2] == (149, 149 + STRETCH_STEPS_N)


def test_a_short_episode_is_a_stretch_as_a_whole() -> None:
    assert stretch(walk(np.ones(31), np.zeros(31)), level=False)[:2] == (0, 30)


def test_stays_cover_a_stretch_row_by_row() -> None:
    frames = pa.table({"face": [3, 3, 1, 1, 1, 3, 7, 7]})
    assert stays(frames, Stretch(1, 6, 0.0)) == [(1, 1, 3), (2, 4, 1), (5, 5, 3), (6, 6, 7)]


def test_clearance_is_the_distance_from_the_plane() -> None:
    line = np.arange(-5, 6) * 0.5
    slope = Terrain(np.tile(0.75 * line[:, None], (1, len(line))), 0.5)
    height_m = float(slope.height(0.3, 0.2))
    assert height_m == pytest.approx(0.75 * 0.3)
    assert clearance(slope, np.array([[0.3, 0.2, height_m + 1.0]])) == pytest.approx(0.8)
    assert clearance(None, np.array([[0.3, 0.2, 0.4]])) == pytest.approx(0.4)


def test_bins_of_speed_hold_all_speeds_and_have_zero_between_two() -> None:
    values = np.array([-0.33, 0.01, 0.049, 0.08, 1.2])
    bounds = speeds.edges(values)
    assert bounds[0] <= values.min() and values.max() < bounds[-1]
    assert np.abs(bounds).min() < 1e-12
    np.testing.assert_allclose(np.diff(bounds), speeds.BIN_M_PER_S)
    assert speeds.share_stuck(values) == pytest.approx(0.4)
