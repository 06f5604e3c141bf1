"""Correlation, slope and their intervals, in closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.service.bench.surrogate.agreement import agreement

EPISODES_N, ROWS_N = 40, 50
EPISODE = np.repeat(np.arange(EPISODES_N), ROWS_N)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_what_comes_true_to_a_factor_has_that_slope_and_correlates_wholly() -> None:
    promised = np.random.default_rng(1).normal(size=len(EPISODE))
    for factor, correlation in ((0.25, 1.0), (-2.0, -1.0)):
        found = agreement(promised, factor * promised + 3, EPISODE, rng())
        for name, value in (("slope", factor), ("correlation", correlation)):
            assert [found[name], found[f"{name}_low"], found[f"{name}_high"]] == pytest.approx([value] * 3)


def test_correlation_and_slope_are_those_of_numpy() -> None:
    promised, noise = np.random.default_rng(2).normal(size=(2, len(EPISODE)))
    realised = 0.3 * promised + noise
    found = agreement(promised, realised, EPISODE, rng())
    assert found["correlation"] == pytest.approx(np.corrcoef(promised, realised)[0, 1])
    assert found["slope"] == pytest.approx(np.polyfit(promised, realised, 1)[0])
    assert found["slope_low"] < 0.3 < found["slope_high"] and found["n"] == len(EPISODE)


def test_what_too_few_values_do_not_tell_is_null() -> None:
    for promised in ([], [1.0], [2.0, 2.0]):
        found = agreement(np.array(promised), np.array(promised), np.arange(len(promised)), rng())
        assert found.pop("n") == len(promised) and set(found.values()) == {None}
    alone = agreement(np.arange(3.0), np.arange(3.0), np.zeros(3, dtype=np.int64), rng())
    assert alone["slope"] == pytest.approx(1) and alone["slope_low"] == pytest.approx(1)


def test_values_that_hang_together_in_an_episode_widen_the_interval() -> None:
    promised, noise = np.random.default_rng(3).normal(size=(2, EPISODES_N))
    promised, realised = promised[EPISODE], (0.3 * promised + noise)[EPISODE]  # each value fifty times
    together = agreement(promised, realised, EPISODE, rng())
    apart = agreement(promised, realised, np.arange(len(EPISODE)), rng())
    widths = [found["slope_high"] - found["slope_low"] for found in (together, apart)]
    assert widths[0] == pytest.approx(widths[1] * np.sqrt(ROWS_N), rel=0.4)
