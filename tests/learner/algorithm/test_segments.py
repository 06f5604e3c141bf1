"""Laws of features, segmentation, classification and warping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.algorithm import warping
from t6gps.learner.algorithm.features import NONE, Rows, read_rows
from t6gps.learner.algorithm.segments import ClassKey, cut, group
from t6gps.storage import schema
from t6gps.storage.errors import DataError

WIDTHS = {"com": 3, "lower-nodes": 21, "nodes": 39, "nodes+vels": 75, "nodes+cables": 63}


def stay_table(make_frames: Callable[..., pa.Table], stays: list[tuple[int, int, int | None, int | None]]) -> pa.Table:
    """One episode of stays (face, rows, entry, exit), kind 0; the last row has no action."""
    face = [face for face, rows, _, _ in stays for _ in range(rows)]
    entry = [entry for _, rows, entry, _ in stays for _ in range(rows)]
    exit_ = [exit_ if row == rows - 1 else None for _, rows, _, exit_ in stays for row in range(rows)]
    actions = [np.zeros(24)] * (len(face) - 1) + [None]
    columns = {"face": face, "entry_edge": entry, "exit_edge": exit_, "action": actions, "action_mean": actions}
    return make_frames(columns, len(face))


@pytest.mark.parametrize("reduced_state", WIDTHS)
def test_every_reduced_state_begins_with_the_velocity(tables: list[pa.Table], reduced_state: str) -> None:
    state = read_rows(dict(enumerate(tables)), reduced_state).state
    velocity = np.concatenate([schema.array(table, "com_velocity") for table in tables])
    assert state.shape == (len(velocity), WIDTHS[reduced_state])
    assert np.array_equal(state[:, :3], velocity)


def test_lower_nodes_are_one_fixed_choice_of_the_lowest_labels_per_kind(tables: list[pa.Table]) -> None:
    episodes = dict(enumerate(tables))
    lower, full = read_rows(episodes, "lower-nodes"), read_rows(episodes, "nodes")
    for kind in (0, 1):
        nodes = full.state[full.kind == kind, 3:].reshape(-1, 12, 3)
        chosen = lower.state[lower.kind == kind, 3:].reshape(-1, 6, 3)
        labels = [int(np.argmax((nodes == chosen[:, [place]]).all(axis=(0, 2)))) for place in range(6)]
        assert np.array_equal(nodes[:, labels], chosen)
        heights = nodes[:, :, 2].mean(axis=0, dtype=np.float64)
        assert set(labels) == set(np.argsort(heights)[:6].tolist())


def test_rows_do_not_depend_on_the_order_of_arrival(tables: list[pa.Table]) -> None:
    episodes = dict(enumerate(tables))
    forward, backward = read_rows(episodes, "nodes"), read_rows(dict(reversed(episodes.items())), "nodes")
    for field in fields(forward):
        one, other = getattr(forward, field.name), getattr(backward, field.name)
        assert one is other or one.tobytes() == other.tobytes()


def test_data_without_a_single_step_or_with_a_missing_action_is_refused(
    tables: list[pa.Table], make_frames: Callable[..., pa.Table]
) -> None:
    with pytest.raises(DataError, match="no episodes"):
        read_rows({}, "nodes")
    with pytest.raises(DataError, match="single control step"):
        read_rows({0: stay_table(make_frames, [(0, 1, None, None)])}, "nodes")
    with pytest.raises(DataError, match="exit_edge"):
        read_rows({0: stay_table(make_frames, [(0, 3, None, 1), (0, 3, None, None)])}, "nodes")
    with pytest.raises(DataError, match="episode 7"):
        read_rows({7: tables[0].slice(0, 10)}, "nodes")


def test_a_crossing_and_no_jump_is_a_dynamics_sample(make_frames: Callable[..., pa.Table]) -> None:
    table = stay_table(make_frames, [(0, 3, None, 2), (1, 2, 0, None), (5, 2, None, None)])
    assert read_rows({0: table}, "com").continues.tolist() == [True, True, True, True, False, True, False]


def test_every_row_with_an_action_lies_in_exactly_one_segment(rows: Rows) -> None:
    segments = cut(rows, 20)
    covered = np.zeros(len(rows.acts), dtype=int)
    for number, (start, stop) in enumerate(zip(segments.start, segments.stop, strict=True)):
        covered[start:stop] += 1
        assert 1 <= stop - start <= 20
        assert (segments.of_row[start:stop] == number).all()
        assert not rows.starts[start + 1 : stop].any()
    assert np.array_equal(covered, rows.acts.astype(int))
    assert (segments.of_row[~rows.acts] == NONE).all()


def test_a_long_stay_is_cut_into_truncated_pieces_and_a_rest(make_frames: Callable[..., pa.Table]) -> None:
    stays = [(0, 5, None, 1), (1, 50, 0, 2), (2, 40, 1, None), (9, 3, None, 0), (4, 2, 0, None)]
    segments = cut(read_rows({0: stay_table(make_frames, stays)}, "com"), 20)
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


def test_classes_depend_on_canonical_columns_only(tables: list[pa.Table]) -> None:
    rng = np.random.default_rng(0)
    copies = {}
    for number, table in enumerate(tables):
        relabelled = rng.permutation(20)[schema.array(table, "face")]
        world = {"face": relabelled, "element": rng.integers(0, 24, len(table)), "com_x_m": rng.normal(size=len(table))}
        copy = table
        for name, values in world.items():
            field = table.schema.field(name)
            copy = copy.set_column(table.schema.get_field_index(name), field, pa.array(values, type=field.type))
        copies[number] = copy
    keys = []
    for episodes in (dict(enumerate(tables)), copies):
        segments = cut(read_rows(episodes, "nodes"), 20)
        keys.append([segments.key(number) for number in range(len(segments.start))])
    assert keys[0] == keys[1]


def test_every_segment_lies_in_one_group_and_pools_share_kind_and_exit(rows: Rows) -> None:
    segments = cut(rows, 20)
    groups = group(segments, 10)
    assert np.array_equal(np.sort(np.concatenate([g.segments for g in groups])), np.arange(len(segments.start)))
    assert any(g.pooled for g in groups) and not all(g.pooled for g in groups)
    for g in groups:
        assert {(segments.key(i).kind, segments.key(i).exit) for i in g.segments} == {(g.key.kind, g.key.exit)}
        assert np.array_equal(np.sort(np.concatenate(list(g.classes.values()))), g.segments)
        for key, members in g.classes.items():
            assert {segments.key(i) for i in members} == {key}
            assert (len(members) < 10) == g.pooled


def test_groups_do_not_depend_on_the_order_of_episodes(tables: list[pa.Table]) -> None:
    def keys(order: list[pa.Table]) -> list[tuple[ClassKey, bool, int]]:
        groups = group(cut(read_rows(dict(enumerate(order)), "com"), 20), 10)
        return [(g.key, g.pooled, len(g.segments)) for g in groups]

    assert keys(tables) == keys(tables[::-1])


@pytest.mark.parametrize("crosses", [False, True])
def test_warping_keeps_order_and_maps_ends_to_ends(crosses: bool) -> None:
    for n in range(1, 25):
        for steps in range(2 if crosses else 1, 21):
            step = warping.align(np.arange(n), np.full(n, n), steps, crosses)
            assert step[-1] == steps - 1 and (np.diff(step) >= 0).all()
            assert step[0] == (0 if n > 1 else steps - 1)
            if crosses:
                assert (step == steps - 1).sum() == 1


def test_warping_is_the_identity_at_the_median_length() -> None:
    lengths = np.array([3, 7, 7, 12])
    assert warping.class_steps(lengths, False) == 7
    assert warping.align(np.arange(7), np.full(7, 7), 7, False).tolist() == list(range(7))


def test_a_crossing_has_a_step_of_its_own_even_in_a_class_of_single_steps() -> None:
    assert warping.class_steps(np.array([1, 1, 1, 5]), True) == 2
    assert warping.class_steps(np.array([1, 1]), True) == 1
