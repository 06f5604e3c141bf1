"""Laws of segmentation and classification."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from t6gps.learner.algorithm.segments import ClassKey, Segments, cut, group
from t6gps.learner.rows import NONE, Rows
from t6gps.storage import schema

Read = Callable[..., tuple[Rows, Segments]]


def test_every_row_with_an_action_lies_in_exactly_one_segment(rows: Rows, segments: Segments) -> None:
    covered = np.zeros(len(rows.acts), dtype=int)
    for number, (start, stop) in enumerate(zip(segments.start, segments.stop, strict=True)):
        covered[start:stop] += 1
        assert 1 <= stop - start <= 20
        assert (segments.of_row[start:stop] == number).all()
        assert not rows.starts[start + 1 : stop].any()
    assert np.array_equal(covered, rows.acts.astype(int))
    assert (segments.of_row[~rows.acts] == NONE).all()


def test_a_long_stay_is_cut_into_truncated_pieces_and_a_rest(make_stays: Callable[..., pa.Table], read: Read) -> None:
    stays = [(0, 5, None, 1), (1, 50, 0, 2), (2, 40, 1, None), (9, 3, None, 0), (4, 2, 0, None)]
    _, segments = read([make_stays(stays)], "com", 20)
    lengths = segments.stop - segments.start
    assert [(int(lengths[i]), *segments.key(i)[1:]) for i in range(len(lengths))] == [
        (5, NONE, 1, False),
        (20, 0, NONE, True),
        (20, NONE, NONE, True),
        (10, NONE, 2, False),
        (20, 1, NONE, True),
        (20, NONE, NONE, False),
        (3, NONE, 0, False),
        (1, 0, NONE, False),
    ]


def test_classes_depend_on_canonical_columns_only(tables: list[pa.Table], read: Read) -> None:
    rng = np.random.default_rng(0)
    copies = []
    for table in tables:
        relabelled = rng.permutation(20)[schema.array(table, "face")]
        world = {"face": relabelled, "element": rng.integers(0, 24, len(table)), "com_x_m": rng.normal(size=len(table))}
        copy = table
        for name, values in world.items():
            field = table.schema.field(name)
            copy = copy.set_column(table.schema.get_field_index(name), field, pa.array(values, type=field.type))
        copies.append(copy)
    keys = []
    for episodes in (tables, copies):
        _, segments = read(episodes)
        keys.append([segments.key(number) for number in range(len(segments.start))])
    assert keys[0] == keys[1]


def test_every_segment_lies_in_one_group_and_pools_share_kind_and_exit(segments: Segments) -> None:
    groups = group(segments, 10)
    assert np.array_equal(np.sort(np.concatenate([g.segments for g in groups])), np.arange(len(segments.start)))
    assert any(g.pooled for g in groups) and not all(g.pooled for g in groups)
    for g in groups:
        assert {(segments.key(i).kind, segments.key(i).exit) for i in g.segments} == {(g.key.kind, g.key.exit)}
        assert np.array_equal(np.sort(np.concatenate(list(g.classes.values()))), g.segments)
        for key, members in g.classes.items():
            assert {segments.key(i) for i in members} == {key}
            assert (len(members) < 10) == g.pooled


def test_groups_do_not_depend_on_the_order_of_episodes(tables: list[pa.Table], read: Read) -> None:
    def keys(order: list[pa.Table]) -> list[tuple[ClassKey, bool, int]]:
        groups = group(read(order)[1], 10)
        return [(g.key, g.pooled, len(g.segments)) for g in groups]

    assert keys(tables) == keys(tables[::-1])


def test_cutting_episodes_one_by_one_is_cutting_them_all(rows: Rows, segments: Segments) -> None:
    pieces = cut(rows.starts, rows.acts, 20)
    for name in ("start", "stop"):
        assert np.array_equal(getattr(pieces, name), getattr(segments, name))
    assert np.array_equal(pieces.leaves, ~segments.truncated)
