"""Laws of the stream of episodes: order, copies, and refusals that name the episode."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.algorithm.segments import Segments
from t6gps.learner.episodes import BLOCK_BYTES
from t6gps.learner.learner import Learner
from t6gps.learner.rows import Rows
from t6gps.learner.settings import LearnerSettings, Localization
from t6gps.storage import ipc
from t6gps.storage.errors import DataError

Read = Callable[..., tuple[Rows, Segments]]


@pytest.mark.parametrize("reduced_state", ["nodes", "lower-nodes"])
def test_rows_and_segments_do_not_depend_on_the_order_of_arrival(
    tables: list[pa.Table], read: Read, reduced_state: str
) -> None:
    shuffled = [tables[number] for number in np.random.default_rng(0).permutation(len(tables))]
    for forward, backward in zip(read(tables, reduced_state), read(shuffled, reduced_state), strict=True):
        for field in fields(forward):
            first, second = getattr(forward, field.name), getattr(backward, field.name)
            assert first is second or first.tobytes() == second.tobytes()


def test_episodes_of_any_length_come_back_row_by_row(make_stays: Callable[..., pa.Table], read: Read) -> None:
    """Rows of more bytes than a block holds, and episodes without a step between others."""
    rng = np.random.default_rng(1)
    lengths = [*rng.integers(1, 400, 20).tolist(), 1, BLOCK_BYTES // (83 * 4) + 2]
    tables = []
    for number, length in enumerate(lengths):
        table = make_stays([(0, length, None, None)])
        column = pa.array(np.full(length, number), type=pa.int64())
        tables.append(table.set_column(0, "episode_id", column))
    rows, segments = read([tables[number] for number in rng.permutation(len(tables))], "com", 30)
    assert np.diff(np.flatnonzero(~rows.acts), prepend=-1).tolist() == lengths
    assert (segments.stop - segments.start).sum() == rows.acts.sum()
    assert len(segments.start) == sum(-(-(length - 1) // 30) for length in lengths)


@pytest.mark.parametrize(
    "settings",
    [
        LearnerSettings(reduced_state="nodes+vels", value_from=1),
        LearnerSettings(reduced_state="lower-nodes"),
        LearnerSettings(localization=Localization.TIME),
    ],
)
def test_nothing_of_a_table_is_kept(
    tables: list[pa.Table], make_learner: Callable[..., Learner], settings: LearnerSettings
) -> None:
    learner, place = make_learner(**settings.model_dump()), tables[0].schema.get_field_index("waypoint_x_m")
    table = tables[0].set_column(place, tables[0].schema.field(place), pa.array(np.ones(len(tables[0]))))
    lent = np.frombuffer(ipc.pack(table), dtype=np.uint8).copy()
    memory = weakref.ref(lent)
    (table,) = ipc.unpack(pa.py_buffer(lent), 1)
    learner.add(table, 0.1)
    del table, lent
    gc.collect()
    assert memory() is None
    with pytest.raises(DataError, match=r"episode 0 was added twice in iteration 0"):
        learner.add(tables[0], 0.1)


def test_episodes_that_cannot_be_learned_from_are_refused_by_their_number(
    tables: list[pa.Table], make_stays: Callable[..., pa.Table], read: Read
) -> None:
    with pytest.raises(DataError, match="no episodes"):
        read([])
    with pytest.raises(DataError, match="none of the 1 episodes has a single control step"):
        read([make_stays([(0, 1, None, None)])])
    with pytest.raises(DataError, match="episode 0: a row has an exit_edge"):
        read([make_stays([(0, 3, None, 1), (0, 3, None, None)])])
    with pytest.raises(DataError, match="episode 7: only the last row may lack an action, found 0 null actions"):
        read([tables[7].slice(0, 10)])
