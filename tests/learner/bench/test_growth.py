"""The sizes of the benchmark of growth are what they are called, each learned from in a process of its own."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow as pa

from t6gps.learner.bench import growth
from t6gps.learner.learner import Learner
from t6gps.learner.settings import LearnerSettings


def test_seconds_and_memory_of_every_size_are_measured(tables: list[pa.Table]) -> None:
    settings = LearnerSettings(hidden_layers=(16,), epochs=1, smallest_class_segments=10)
    new_learner = partial(
        Learner,
        settings,
        run_seed=3,
        target_speed_m_per_s=0.8,
        vertical_weight=0.1,
        command_range_m=(0.65, 1.35),
        offset_m=1.088,
        scale_m=0.2,
        reach_m=0.07,
        world_labels=np.tile(np.arange(24), (24, 1)),
        mirrored=np.zeros(24, dtype=bool),
    )
    figures = growth.measure(new_learner, tables, factors=(1, 2))
    assert figures["learner_2x_steps"] == 2 * figures["learner_1x_steps"] == 2 * 12 * 80
    for factor in (1, 2):
        assert figures[f"learner_{factor}x_seconds"] > 0 and figures[f"learner_{factor}x_peak_mb"] > 50
