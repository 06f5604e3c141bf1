"""The references of the learner's benchmark solve the same problems."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.bench import speed
from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.errors import DataError


def test_phases_are_measured_and_compared_at_equal_inliers_and_gains(
    tables: list[pa.Table], make_learner: Callable[..., Learner], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = LearnerSettings(
        smallest_class_segments=1000, longest_segment_steps=3, modes=1
    )  # few classes, large bins
    monkeypatch.setattr(speed, "BINS", 2)
    result = speed.measure(make_learner, tables, settings)
    assert result["steps"] == 12 * 80 and result["pairs"] == 2 * 12 * 80
    assert all(result[f"{phase.name}_s"] > 0 for phase in PHASES)
    assert result["fit_speedup_over_sklearn"] > 1 and result["backward_pass_speedup_over_loop"] > 1
    assert 0 < result["gain_error"] < 1e-6
    assert 0 < result["inlier_share"] <= 1 and 0 < result["sklearn_inlier_share"] <= 1


def test_a_fit_that_misses_planted_inliers_is_reported() -> None:
    with pytest.raises(DataError, match="980 planted inliers"):
        speed.check_planted_inliers(lambda step: np.ones(len(step.samples), dtype=bool))
