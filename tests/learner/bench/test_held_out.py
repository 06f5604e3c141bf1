"""Models predict episodes that they were not fitted to, as well as the noise of the world allows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from t6gps.learner.algorithm.segments import Segments, group
from t6gps.learner.bench.held_out import held_out
from t6gps.learner.report import Segmented
from t6gps.learner.rows import NONE, VELOCITY_N, Flags, Rows
from t6gps.learner.settings import LearnerSettings, Localization
from t6gps.storage.records import PolicySnapshot

VELOCITY_NOISE_M_PER_S = 0.02
"""Of the small world."""


BOTH = pytest.mark.parametrize("localization", [Localization.SEGMENTS, Localization.KIND])


@pytest.fixture(scope="module")
def segmented(world: Any, untrained: PolicySnapshot, read: Callable[..., tuple[Rows, Segments]]) -> Segmented:
    rows, segments = read(world.episodes(untrained, episodes=32, steps=80, seed=2))
    return Segmented(rows, segments, group(segments, 40))


def last_episodes(rows: Rows, episodes_n: int) -> Flags:
    ends = np.flatnonzero(~rows.acts)
    return np.arange(len(rows.acts)) > ends[-1 - episodes_n]


@BOTH
def test_what_is_held_out_is_predicted_to_the_noise(segmented: Segmented, localization: Localization) -> None:
    chosen = last_episodes(segmented.rows, 8)
    found = held_out(LearnerSettings(localization=localization), segmented, 3, 0, chosen)
    assert chosen[found.rows].all() and len(np.unique(found.rows)) == len(found.rows)
    assert found.known_share == pytest.approx(len(found.rows) / (segmented.rows.continues & chosen).sum())
    assert found.known_share > 0.9
    stays = segmented.rows.exit[found.rows] == NONE  # crossings are too few to learn from
    error = (found.after - found.predicted)[stays, :VELOCITY_N]
    assert VELOCITY_NOISE_M_PER_S**2 * 0.8 < np.square(error).mean() < VELOCITY_NOISE_M_PER_S**2 * 1.5


@BOTH
def test_the_models_have_not_seen_what_is_held_out(segmented: Segmented, localization: Localization) -> None:
    settings, rows = LearnerSettings(localization=localization), segmented.rows
    chosen, strange = last_episodes(rows, 8), last_episodes(rows, 1)
    state = np.where(strange[:, None], -3 * rows.state, rows.state)
    before = held_out(settings, segmented, 3, 0, chosen)
    after = held_out(settings, replace(segmented, rows=replace(rows, state=state)), 3, 0, chosen)
    assert np.array_equal(before.rows, after.rows)
    others = ~strange[before.rows]
    assert np.array_equal(before.predicted[others], after.predicted[others])
    assert not np.array_equal(before.predicted[~others], after.predicted[~others])
