"""Laws of a run that a later version goes on with: readers of Delta tables see the new columns, null in old rows."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import polars
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import synthetic
from deltalake import DeltaTable, Schema
from deltalake.transaction import AddAction, CommitProperties, Transaction

from t6gps.storage import schema, tables
from t6gps.storage.care.repair import repair
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints, evaluations
from t6gps.storage.objects import publishing
from t6gps.storage.objects.place import ObjectPath

LATER = {"iterations": 6, "frames": 2, "evaluations": 10}
"""How many columns at its end a table has that some earlier version did not know."""


def evaluate(run: Run) -> None:
    names = [column for column in schema.EVALUATIONS if column.name != "evaluation_id"]
    row: dict[str, object] = {column.name: "{}" if column.type == pa.string() else 1 for column in names}
    evaluations.commit(run, row | {"episodes": synthetic.EPISODES_N}, synthetic.episodes(0))


@pytest.fixture
def old(tmp_path: Path) -> Run:
    """A run of one iteration and one evaluation, as an earlier version left it: its tables lack the later columns."""
    run = synthetic.made(tmp_path, 1)
    evaluate(run)
    for table, lacking_n in LATER.items():
        names = schema.TABLES[table].names[:-lacking_n]
        rows = tables.read(run, table, names).replace_schema_metadata({"t6gps_schema_version": "6"})
        (file,) = (run.tables / table).glob("*.parquet")
        shutil.rmtree(file.parent / "_delta_log")
        pq.write_table(rows, file)
        added = AddAction(file.name, file.stat().st_size, {}, 0, True, json.dumps({"numRecords": rows.num_rows}))
        number = CommitProperties(app_transactions=[Transaction("t6gps", 0)])
        DeltaTable.create(str(file.parent), Schema.from_arrow(rows.schema)).create_write_transaction(
            [added], "append", Schema.from_arrow(rows.schema), commit_properties=number
        )
    return run


def go_on(run: Run, iterations_n: int = 2) -> None:
    for iteration in range(1, iterations_n):
        synthetic.commit(run, iteration)
    evaluate(run)


def test_readers_of_delta_tables_see_later_columns_null_in_earlier_rows(old: Run) -> None:
    go_on(old)
    for table, lacking_n in LATER.items():
        definition = schema.TABLES[table]
        found = DeltaTable(old.tables / table).to_pyarrow_table()
        assert found.column_names == definition.names
        assert polars.read_delta(str(old.tables / table)).columns == definition.names
        new = found.column(definition.names[0]).to_numpy() >= (synthetic.EPISODES_N if table == "frames" else 1)
        for name in definition.names[-lacking_n:]:
            assert found.column(name).is_valid().to_pylist() == new.tolist(), (table, name)
        assert [field.type for field in found.schema] == [field.type for field in definition]


def test_columns_come_once_and_also_after_a_commit_that_was_cut_off(old: Run) -> None:
    go_on(old)
    for table in LATER:
        entries = sorted((old.tables / table / "_delta_log").glob("*.json"))
        assert [("metaData" in entry.read_text(), '"add"' in entry.read_text()) for entry in entries] == [
            (True, False),
            (False, True),
            (True, False),
            (False, True),
        ]
    cut = old.tables / "evaluations" / "_delta_log" / f"{3:020d}.json"  # the columns have come, their rows not
    cut.unlink()
    assert tables.read(old, "evaluations").num_rows == 1
    evaluate(old)
    entries = sorted((old.tables / "evaluations" / "_delta_log").glob("*.json"))
    assert ["metaData" in entry.read_text() for entry in entries] == [True, False, True, False]
    assert tables.read(old, "evaluations").num_rows == 2
    assert verify(old) == []


def test_a_run_whose_columns_have_come_is_checkpointed_and_mended_as_others_are(old: Run) -> None:
    go_on(old, checkpoints.EVERY_N + 2)
    assert verify(old) == []
    rows = {name: tables.read(old, name) for name in schema.TABLES}
    for table in ("frames", "episodes"):
        assert len(checkpoints.kept(old.tables / table / "_delta_log")) == 1
    (old.tables / "frames" / "_delta_log" / f"{4:020d}.json").unlink()
    assert repair(old, None, verify).left == []
    assert {name: tables.read(old, name) for name in schema.TABLES} == rows


@pytest.mark.parametrize("iteration", [0, 1, 2])
def test_a_file_that_is_damaged_costs_what_follows_it_and_the_log_keeps_no_gap(old: Run, iteration: int) -> None:
    go_on(old, 4)
    (file,) = (old.tables / "frames").glob(f"*{iteration:06d}.parquet")
    os.truncate(file, 100)
    assert repair(old, None, verify).left == []
    assert tables.committed_iterations(old) == iteration


def test_columns_that_came_are_copied_in_their_turn(old: Run, objects: ObjectPath) -> None:
    go_on(old, 3)
    seen, there = list[int](), Run(objects / old.name)

    def look(done: int, total: int) -> None:
        if done % 8 == 0 or done == total:
            seen.append(tables.committed_iterations(there))
            assert tables.read(there, "iterations").num_rows == seen[-1] == publishing.iterations(there.path)

    publishing.publish(old.path, there.path, progress=look)
    assert set(seen) == {0, 1, 2, 3}
    assert verify(there) == []
