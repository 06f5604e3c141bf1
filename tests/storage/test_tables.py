from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable, write_deltalake
from deltalake.transaction import CommitProperties, Transaction

from t6gps.storage import catalog, fields, schema, tables
from t6gps.storage.care.repair import repair
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations, log, policies
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.records import Episode
from t6gps.storage.sql.query import Question, query

ORDER = ["frames", "classes", "models", "policies", "iterations", "episodes"]
"""In which tables are committed: an iteration is there when it stands in the last one."""


def _snapshot(run: Run) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(run.path.rglob("*")) if path.is_file()}


def test_what_was_committed_is_what_was_sampled_bit_for_bit(run: Run, commit: Any, bits: Any) -> None:
    episodes = commit(run, 0) + commit(run, 1)
    frames = pa.concat_tables([episode.frames for episode in episodes])
    values = np.concatenate([schema.array(frames, name) for name in ("nodes", "action")], axis=None)
    assert (np.signbit(values) & (values == 0)).any(), "the data must hold -0.0"
    assert ((values != 0) & (np.abs(values) < np.finfo(np.float32).tiny)).any(), "the data must hold denormals"
    assert bits(tables.read(run, "frames")) == bits(frames)
    summaries = pa.concat_tables([episode.summary for episode in episodes])
    assert bits(tables.read(run, "episodes")) == bits(summaries)


@pytest.mark.parametrize("table", schema.OF_ITERATIONS)
def test_what_is_read_has_the_schema_to_the_letter(run: Run, commit: Any, table: str) -> None:
    assert tables.read(run, table).num_rows == 0
    assert tables.read(run, table).schema.equals(schema.TABLES[table], check_metadata=True)
    commit(run, 0)
    found = tables.read(run, table)
    assert found.num_rows > 0
    assert found.schema.equals(schema.TABLES[table], check_metadata=True)
    fields.check(found, schema.TABLES[table], "read")


def test_rows_of_the_learner_are_kept_as_given(run: Run, commit: Any, learn: Any, bits: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    given = [learn(0), learn(1)]
    assert tables.read(run, "iterations").to_pylist() == [learned.iteration for learned in given]
    assert tables.read(run, "classes").to_pylist() == [row for learned in given for row in learned.classes]
    assert bits(tables.read(run, "models")) == bits(pa.concat_tables([learned.models for learned in given]))


def test_every_policy_is_kept_to_the_bit_under_its_version(run: Run, commit: Any, learn: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    for policy in (*learn(0).policies, *learn(1).policies):
        kept = tables.policy(run, policy.version)
        assert (kept.version, kept.offset_m, kept.scale_m) == (policy.version, policy.offset_m, policy.scale_m)
        for layer, given in zip(kept.layers, policy.layers, strict=True):
            assert all(np.array_equal(part, wanted) for part, wanted in zip(layer, given, strict=True))
    lineage = tables.read(run, "policies", ["version", "iteration", "parent"]).to_pylist()
    assert [tuple(row.values()) for row in lineage] == [(0, None, None), (1, 0, 0), (2, 1, 1)]


def test_a_policy_that_was_altered_fails_its_sum(learn: Any) -> None:
    row = policies.row(learn(0).policies[1])
    policies.policy(row)
    with pytest.raises(DataError, match="policy 1 fails its SHA-256"):
        policies.policy(row | {"weights": np.nextafter(row["weights"], np.float32(np.inf))})


def test_a_run_of_version_5_is_read_without_models_and_policies_and_can_go_on(run: Run, commit: Any) -> None:
    commit(run, 0)
    for name in schema.YOUNGER:
        shutil.rmtree(run.tables / name)
    with pytest.raises(DataError, match=r"table models .* it is missing"):
        tables.files(run)
    file = run.tables / "episodes" / "iteration-000000.parquet"
    older = pq.read_table(file).replace_schema_metadata({"t6gps_schema_version": "5"})
    pq.write_table(older, file)
    log = run.tables / "episodes" / "_delta_log" / f"{1:020d}.json"
    log.write_text(re.sub(r'"size":\d+', f'"size":{file.stat().st_size}', log.read_text()))
    assert [tables.read(run, name).num_rows for name in schema.YOUNGER] == [0, 0]
    tables.files(run)
    commit(run, 1)
    tables.files(run)
    assert tables.read(run, "policies", ["version"]).to_pylist() == [{"version": 2}]


def test_a_run_of_the_first_schema_version_is_read_with_null_for_later_columns_and_can_go_on(
    run: Run, commit: Any
) -> None:
    later = {"iterations": 6, "classes": 3}
    commit(run, 0)
    for name, n in later.items():
        rows = tables.read(run, name)
        shutil.rmtree(run.tables / name)
        committed = CommitProperties(app_transactions=[Transaction("t6gps", 0)])
        write_deltalake(run.tables / name, rows.select(rows.column_names[:-n]), commit_properties=committed)
    commit(run, 1)
    for name, n in later.items():
        table = tables.read(run, name).sort_by("iteration")
        for column in schema.TABLES[name].names[-n:]:
            values = table.column(column).to_pylist()
            assert values[0] is None and values[-1] is not None
        assert table.column("cost" if name == "iterations" else "residual").null_count == 0


def test_what_there_is_none_of_is_null_also_where_an_older_run_has_zero(run: Run, commit: Any, learn: Any) -> None:
    """Version 4 allowed no null in these columns of a table that is there."""
    none = {"iterations": ("cost_standard_error", "waypoints_per_episode"), "classes": ("modes", "residual")}
    episodes = commit(run, 0)
    for name, columns in none.items():
        table = tables.read(run, name)
        for column in columns:
            place = table.schema.get_field_index(column)
            table = table.set_column(place, table.schema.field(place).with_nullable(False), table.column(place))
        shutil.rmtree(run.tables / name)
        committed = CommitProperties(app_transactions=[Transaction("t6gps", 0)])
        write_deltalake(run.tables / name, table, commit_properties=committed)
    commit(run, 1)
    iteration = learn(2).iteration | dict.fromkeys(none["iterations"])
    classes = [row | dict.fromkeys(none["classes"]) for row in learn(2).classes]
    numbered = pa.array([2], pa.int32()).take
    later = [
        table.set_column(1, table.schema.field(1), numbered(pa.array([0] * table.num_rows)))
        for table in (episodes[0].frames, episodes[0].summary)
    ]
    iterations.commit(run, 2, iter([Episode(*later)]), learn(2, iteration=iteration, classes=classes))
    for name, columns in none.items():
        table = tables.read(run, name).sort_by("iteration")
        for column in columns:
            values = table.column(column).to_pylist()
            assert values[0] is not None and values[-1] is None


def test_columns_and_rows_can_be_chosen(run: Run, commit: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    found = tables.read(run, "frames", ["nodes", "episode_id"], pc.field("iteration") == 1)
    assert found.column_names == ["nodes", "episode_id"]
    assert found.column("episode_id").unique().to_pylist() == [100, 101, 102]
    assert found.schema.field("nodes").metadata[b"unit"] == b"m"


def test_one_episode_is_read_whole_and_in_order(run: Run, commit: Any, bits: Any) -> None:
    episodes = commit(run, 0) + commit(run, 1)
    assert bits(tables.episode(run, 101).frames) == bits(episodes[4].frames)


def test_unknown_tables_columns_and_episodes_are_answered_with_those_that_exist(run: Run, commit: Any) -> None:
    with pytest.raises(DataError, match="no iteration is committed"):
        tables.episode(run, 0)
    commit(run, 0)
    with pytest.raises(DataError, match=r"3 episodes lie in 0 \.\. 2"):
        tables.episode(run, 3)
    with pytest.raises(DataError, match="no table 'frame'; tables: frames, episodes"):
        tables.read(run, "frame")
    with pytest.raises(DataError, match="no column 'speed'; columns: episode_id"):
        tables.read(run, "frames", ["speed"])


def test_committing_twice_changes_nothing(run: Run, commit: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    before = _snapshot(run)
    commit(run, 0)
    commit(run, 1)
    assert _snapshot(run) == before


def test_tables_are_committed_in_turn_and_episodes_last(run: Run, commit: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    for version in (1, 2):  # version 0 is the empty table
        logs = [run.tables / table / "_delta_log" / f"{version:020d}.json" for table in ORDER]
        times = [log.stat().st_mtime_ns for log in logs]
        assert times == sorted(times)


@pytest.mark.parametrize("committed_n", range(len(ORDER)))
@pytest.mark.parametrize("file_written", [False, True])
def test_a_crash_inside_a_commit_shows_whole_iterations_only_and_is_completed_by_committing_again(
    run: Run, commit: Any, commit_cut_off: Any, bits: Any, committed_n: int, file_written: bool
) -> None:
    whole = commit(run, 0)
    commit_cut_off(run, 1, " ".join(ORDER[:committed_n]), ORDER[committed_n] if file_written else "")
    assert tables.committed_iterations(run) == 1
    assert bits(tables.read(run, "frames")) == bits(pa.concat_tables([each.frames for each in whole]))
    for table in ORDER:
        assert set(tables.read(run, table).column("iteration").to_pylist()) <= {0, None}
    with pytest.raises(DataError, match="has no episode 100"):
        tables.episode(run, 100)

    whole += commit(run, 1)
    assert tables.committed_iterations(run) == 2
    assert bits(tables.read(run, "frames")) == bits(pa.concat_tables([each.frames for each in whole]))
    for table in ORDER:
        assert set(tables.read(run, table).column("iteration").to_pylist()) - {None} == {0, 1}


def test_a_cut_off_commit_is_not_completed_with_other_episodes(
    run: Run, commit_cut_off: Any, make_episode: Any, learn: Any
) -> None:
    commit_cut_off(run, 0, "frames")
    with pytest.raises(DataError, match="holds other episodes"):
        iterations.commit(run, 0, [make_episode(9, 0)], learn(0))
    assert tables.committed_iterations(run) == 0


def test_iterations_are_committed_in_turn(run: Run, commit: Any) -> None:
    assert tables.committed_iterations(run) == 0
    with pytest.raises(RunError, match="next is 0, found 1"):
        commit(run, 1)
    commit(run, 0)
    assert tables.committed_iterations(run) == 1


def _bad(good: Episode, row: dict[str, object], classes: list[dict[str, object]]) -> list[tuple[Any, ...]]:
    return [
        ([], row, classes, "no episodes"),
        ([good, good], row, classes, "each once; found 1 after 1"),
        ([good], row | {"speed": 1}, classes, "exactly"),
        ([good], {"iteration": 0}, classes, "exactly"),
        ([good], row | {"iteration": 1}, classes, "belongs to iteration 1"),
        ([good], row | {"cost": float("inf")}, classes, "not finite"),
        ([good], row | {"cost": None}, classes, "must not be null"),
        ([good], row | {"cost": "cheap"}, classes, "iterations of iteration 0"),
        ([good], row | {"segments": 2**40}, classes, "iterations of iteration 0"),
        ([good], row, [classes[0] | {"kind": None}], "must not be null"),
    ]


@pytest.mark.parametrize("case", range(10))
def test_data_that_break_their_schema_are_refused_and_nothing_is_written(
    run: Run, make_episode: Any, learn: Any, case: int
) -> None:
    episodes, row, classes, reason = _bad(make_episode(1, 0), learn(0).iteration, learn(0).classes)[case]
    before = _snapshot(run)
    with pytest.raises(DataError, match=reason):
        iterations.commit(run, 0, episodes, learn(0, iteration=row, classes=classes))
    assert _snapshot(run) == before


def test_a_file_holds_ten_episodes_a_row_group_and_splits_noisy_floats(run: Run, make_episode: Any, learn: Any) -> None:
    episodes = [make_episode(index, 0) for index in range(23)]
    iterations.commit(run, 0, episodes, learn(0, classes=[]))
    assert tables.read(run, "classes").num_rows == 0
    metadata = pq.ParquetFile(run.tables / "frames" / "iteration-000000.parquet").metadata
    assert [metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)] == [60, 60, 18]
    columns = [metadata.row_group(0).column(index) for index in range(metadata.num_columns)]
    encodings = {column.path_in_schema: column.encodings for column in columns}
    assert {column.compression for column in columns} == {"ZSTD"}
    for name in ("cost", "nodes.list.element", "action.list.element"):
        assert "BYTE_STREAM_SPLIT" in encodings[name]
        assert "RLE_DICTIONARY" not in encodings[name]
    assert "RLE_DICTIONARY" in encodings["episode_id"]


def test_other_readers_of_delta_see_the_same_rows(run: Run, commit: Any) -> None:
    episodes = commit(run, 0) + commit(run, 1)
    delta = DeltaTable(str(run.tables / "episodes"))
    assert delta.to_pyarrow_table().num_rows == len(episodes)
    actions = pa.table(delta.get_add_actions(flatten=True)).sort_by("path").to_pylist()
    assert [(action["num_records"], action["min.episode_id"], action["max.episode_id"]) for action in actions] == [
        (3, 0, 2),
        (3, 100, 102),
    ]
    described = DeltaTable(str(run.tables / "frames")).schema().to_arrow()
    assert pa.schema(described).field("cost").metadata[b"unit"] == b"m2/s2"


def test_a_root_with_blanks_and_accents_works_also_when_relative(
    tmp_path: Path, commit: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = catalog.create(Path("my rüns #1"), "one", "{}")
    commit(run, 0)
    assert tables.read(run, "episodes").num_rows == 3
    assert tables.episode(run, 1).frames.num_rows == 6


DAMAGES: dict[str, Callable[[Path], object]] = {
    "gap in the log": lambda table: (table / "_delta_log" / f"{1:020d}.json").unlink(),
    "commit without content": lambda table: (table / "_delta_log" / f"{2:020d}.json").write_text(""),
    "commit that is no JSON": lambda table: (table / "_delta_log" / f"{2:020d}.json").write_text("no"),
    "commits that are gone": lambda table: [
        (table / "_delta_log" / f"{number:020d}.json").unlink() for number in (2, 3)
    ],
    "no table": shutil.rmtree,
    "no file": lambda table: (table / "iteration-000001.parquet").unlink(),
    "half a file": lambda table: os.truncate(table / "iteration-000001.parquet", 100),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("table", schema.OF_ITERATIONS)
def test_damage_is_one_clear_error(run: Run, commit: Any, table: str, damage: str) -> None:
    for iteration in range(3):
        commit(run, iteration)
    DAMAGES[damage](run.tables / table)
    with pytest.raises(DataError, match=f"run trial is not whole: table {table} in .*restore") as refused:
        tables.files(run)
    assert "\n" not in str(refused.value)
    with pytest.raises(DataError, match="run trial is not whole"):
        query(Question([run], f"SELECT count(*) FROM {table}"))


def written_by_others(run: Run, table: str, version: int, names: list[str]) -> None:
    """Let another program write the newest file of a table, of a version and with columns of its own."""
    file = sorted((run.tables / table).glob("*.parquet"))[-1]
    rows = pq.read_table(file)
    kept = pa.table([rows.column(min(rows.num_columns - 1, place)) for place in range(len(names))], names=names)
    pq.write_table(kept.replace_schema_metadata({"t6gps_schema_version": str(version)}), file)
    entry = sorted((file.parent / "_delta_log").glob("*.json"))[-1]
    entry.write_text(re.sub(r'"size":\d+', f'"size":{file.stat().st_size}', entry.read_text()))


@pytest.mark.parametrize("table", schema.OF_ITERATIONS)
def test_a_run_of_a_later_version_is_refused_and_not_misread(run: Run, commit: Any, table: str) -> None:
    for iteration in range(2):
        commit(run, iteration)
    names = [*schema.TABLES[table].names, "of_a_later_version"]
    written_by_others(run, table, schema.SCHEMA_VERSION + 1, names)
    refused = rf"run trial has tables of version {schema.SCHEMA_VERSION + 1}, and this version reads up to .*; install"
    for ask in (tables.files, lambda run: tables.read(run, table)):
        with pytest.raises(DataError, match=refused):
            ask(run)
    with pytest.raises(DataError, match=refused):
        query(Question([run], f"SELECT count(*) FROM {table}"))
    before = _snapshot(run)
    with pytest.raises(DataError, match=refused):
        repair(run, None, verify)
    assert _snapshot(run).keys() == before.keys(), "it is no damage"


def test_columns_of_something_else_are_refused_and_never_null(run: Run, commit: Any) -> None:
    commit(run, 0)
    whole = schema.FRAMES.names
    for names, wrong in (([*whole[1::-1], *whole[2:]], "must be int64, found int32"), (whole[1:], "is missing")):
        written_by_others(run, "frames", 0, names)
        with pytest.raises(DataError, match=rf"table frames .*000000\.parquet: column episode_id {wrong}.*; restore"):
            tables.read(run, "frames", ["cost"])


def test_a_full_disk_is_an_error_of_the_system_wherever_it_comes_and_loses_nothing(
    run: Run, commit: Any, full_disk: Any, bits: Any
) -> None:
    commit(run, 0)
    before = _snapshot(run)
    with full_disk(), pytest.raises(OSError, match="File too large"):
        commit(run, 1)
    assert _snapshot(run) == before
    log_file = run.tables / "classes" / "_delta_log" / f"{1:020d}.json"
    kept = log_file.read_bytes()
    log_file.unlink()
    rows_file = run.tables / "classes" / "iteration-000000.parquet"
    with full_disk(), pytest.raises(OSError, match="File too large") as refused:
        log.add_again(run, "classes", 0, rows_file)
    assert (refused.value.errno, refused.value.filename) == (errno.EFBIG, str(rows_file.parent))
    log_file.write_bytes(kept)
    episodes = commit(run, 1)
    assert tables.committed_iterations(run) == 2
    assert bits(tables.episode(run, 101).frames) == bits(episodes[1].frames)


def test_a_byte_that_has_changed_in_a_page_is_damage_and_never_an_answer(run: Run, commit: Any) -> None:
    commit(run, 0)
    file = run.tables / "frames" / "iteration-000000.parquet"
    metadata = pq.read_metadata(file)
    columns = [metadata.row_group(0).column(index) for index in range(metadata.num_columns)]
    whole = file.read_bytes()
    for name in ("cost", "face", "nodes.list.element"):
        column = next(column for column in columns if column.path_in_schema == name)
        first = column.dictionary_page_offset if column.has_dictionary_page else column.data_page_offset
        place = first + column.total_compressed_size - 3  # in its last page
        changed = bytearray(whole)
        changed[place] ^= 1
        file.write_bytes(changed)
        with pytest.raises(DataError, match=r"run trial is not whole: table frames .*restore"):
            tables.read(run, "frames")
        with pytest.raises(DataError, match="run trial is not whole"):
            query(Question([run], f"SELECT {name.split('.')[0]} FROM frames"))
    file.write_bytes(whole)
    tables.read(run, "frames")
