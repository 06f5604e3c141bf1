"""Laws of the reduced state and of what is a sample of the dynamics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.algorithm.segments import Segments
from t6gps.learner.rows import Rows
from t6gps.storage import schema

Read = Callable[..., tuple[Rows, Segments]]
WIDTHS = {"com": 3, "lower-nodes": 21, "nodes": 39, "nodes+vels": 75, "nodes+cables": 63}


@pytest.mark.parametrize("reduced_state", WIDTHS)
def test_every_reduced_state_begins_with_the_velocity(tables: list[pa.Table], read: Read, reduced_state: str) -> None:
    state = read(tables, reduced_state)[0].state
    velocity = np.concatenate([schema.array(table, "com_velocity") for table in tables])
    assert state.shape == (len(velocity), WIDTHS[reduced_state])
    assert np.array_equal(state[:, :3], velocity)


def test_lower_nodes_are_one_fixed_choice_of_the_lowest_labels_per_kind(tables: list[pa.Table], read: Read) -> None:
    lower, full = read(tables, "lower-nodes")[0], read(tables, "nodes")[0]
    for kind in (0, 1):
        nodes = full.state[full.kind == kind, 3:].reshape(-1, 12, 3)
        chosen = lower.state[lower.kind == kind, 3:].reshape(-1, 6, 3)
        labels = [int(np.argmax((nodes == chosen[:, [place]]).all(axis=(0, 2)))) for place in range(6)]
        assert np.array_equal(nodes[:, labels], chosen)
        heights = nodes[:, :, 2].mean(axis=0, dtype=np.float64)
        assert set(labels) == set(np.argsort(heights)[:6].tolist())


def test_a_crossing_and_no_jump_is_a_dynamics_sample(make_stays: Callable[..., pa.Table], read: Read) -> None:
    table = make_stays([(0, 3, None, 2), (1, 2, 0, None), (5, 2, None, None)])
    assert read([table], "com")[0].continues.tolist() == [True, True, True, True, False, True, False]
