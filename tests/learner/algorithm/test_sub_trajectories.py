"""Laws of sub-trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.learner.algorithm.sub_trajectories import CHUNK, chunks, sub_trajectories
from t6gps.learner.rows import Rows


@pytest.mark.parametrize("horizon", [1, 7, 10, 1000])
def test_sub_trajectories_cover_every_transition_once_and_never_span_a_gap(rows: Rows, horizon: int) -> None:
    pieces = sub_trajectories(rows.continues, horizon)
    covered = np.zeros(len(rows.continues), dtype=int)
    for length, starts in pieces.items():
        assert 1 <= length <= horizon
        for start in starts:
            covered[start : start + length] += 1
            begins_run = start == 0 or not rows.continues[start - 1]
            assert begins_run or rows.continues[start - 1]
            ends_run = not rows.continues[start + length]
            assert length == horizon or ends_run
    assert np.array_equal(covered, rows.continues.astype(int))


def test_chunks_are_the_rows_of_all_sub_trajectories(rows: Rows) -> None:
    parts = chunks(rows.continues, 4)
    assert max(map(len, parts)) <= CHUNK
    assert np.array_equal(np.sort(np.concatenate([part.ravel() for part in parts])), np.flatnonzero(rows.continues))
