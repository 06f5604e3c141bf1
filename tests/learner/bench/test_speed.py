"""The references of the learner's benchmark solve the same problems."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.algorithm import modes
from t6gps.learner.bench import speed as benchmarks
from t6gps.learner.learner import Learner
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.errors import ConfigError, DataError


def test_phases_are_measured_and_compared_at_equal_inliers_and_gains(
    tables: list[pa.Table], make_learner: Callable[..., Learner], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = LearnerSettings(
        smallest_class_segments=1000, longest_segment_steps=3, modes=1
    )  # few classes, large bins
    monkeypatch.setattr(benchmarks, "BINS", 2)
    result = benchmarks.measure(make_learner, tables, settings)
    assert result["steps"] == 12 * 80 and result["pairs"] == 2 * 12 * 80
    assert all(result[key] > 0 for key in benchmarks.PHASES.values())
    assert result["fit_speedup_over_sklearn"] > 1 and result["backward_pass_speedup_over_loop"] > 1
    assert 0 < result["gain_error"] < 1e-6
    assert 0 < result["inlier_share"] <= 1 and 0 < result["sklearn_inlier_share"] <= 1


def test_a_fit_that_misses_planted_inliers_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmarks, "_first_mode_inliers", lambda samples, *rest: np.ones(len(samples), dtype=bool))
    with pytest.raises(DataError, match="980 planted inliers"):
        benchmarks._check_planted_inliers()


def test_without_scikit_learn_the_benchmark_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.linear_model", None)
    with pytest.raises(ConfigError, match=r"t6gps\[bench\]"):
        next(benchmarks.sklearn_modes(np.zeros((3, 5)), 2, modes.FitOptions(1, 0.35, 0.0, 1e-6)))
