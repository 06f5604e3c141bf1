"""Laws of a query over many runs: each row knows its run, old versions mix, and damage is left out or refused."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from t6gps.storage import catalog, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import parquet
from t6gps.storage.delta.parquet import Files
from t6gps.storage.errors import DataError, QueryError, RunError
from t6gps.storage.sql import views
from t6gps.storage.sql.query import Question, query, write

COUNTS = "SELECT run, count(*) AS n, max(iteration) AS last FROM frames GROUP BY run ORDER BY run"


@pytest.fixture
def runs(tmp_path: Path, commit: Any) -> list[Run]:
    """Three runs, of one, two and three iterations."""
    found = [catalog.create(tmp_path / "runs", name, "{}") for name in ("flat", "rough-a", "rough-b")]
    for iterations_n, run in enumerate(found, start=1):
        for iteration in range(iterations_n):
            commit(run, iteration)
    return found


def test_each_row_knows_its_run_and_is_as_committed(runs: list[Run]) -> None:
    whole = query(Question(runs, "SELECT * FROM episodes ORDER BY run, episode_id"))
    assert whole.column_names == ["run", *schema.EPISODES.names]
    for run in runs:
        alone = whole.filter(pc.field("run") == run.name).drop_columns("run")
        assert alone.to_pylist() == tables.read(run, "episodes").to_pylist()
    found = query(Question(runs, "SELECT * FROM episodes WHERE run = $name ORDER BY ALL", {"name": "flat"}))
    assert found.equals(whole.filter(pc.field("run") == "flat"))


def test_what_was_cut_off_in_one_run_is_not_seen_in_any(runs: list[Run], commit_cut_off: Any) -> None:
    commit_cut_off(runs[1], 2, "frames classes iterations models policies")
    assert query(Question(runs, COUNTS)).to_pylist() == [
        {"run": "flat", "n": 18, "last": 0},
        {"run": "rough-a", "n": 36, "last": 1},
        {"run": "rough-b", "n": 54, "last": 2},
    ]


def test_columns_that_a_version_did_not_know_are_null_beside_those_that_have_them(tmp_path: Path) -> None:
    names = schema.ITERATIONS.names
    kinds = {"old": names[: names.index("left_out")], "new": names}
    for name, names in kinds.items():
        definition = pa.schema([schema.ITERATIONS.field(column) for column in names])
        pq.write_table(pa.Table.from_pylist([dict.fromkeys(names, 1)], definition), tmp_path / f"{name}.parquet")
    found = parquet.rows_of_runs("iterations", {name: Files([str(tmp_path / f"{name}.parquet")]) for name in kinds})
    rows = found.to_table(["run", "steps", "left_out"]).to_pylist()
    assert rows == [{"run": "old", "steps": 1, "left_out": None}, {"run": "new", "steps": 1, "left_out": 1}]


def test_a_damaged_run_is_refused_or_left_out_with_its_reason(runs: list[Run]) -> None:
    (runs[1].tables / "frames" / "iteration-000001.parquet").unlink()
    with pytest.raises(DataError, match="run rough-a is not whole"):
        query(Question(runs, COUNTS))
    told: list[str] = []
    found = query(Question(runs, COUNTS, left_out=told.append))
    assert found.column("run").to_pylist() == ["flat", "rough-b"]
    assert len(told) == 1
    assert "run rough-a is not whole: table frames" in told[0]


def test_a_byte_that_has_changed_in_a_page_names_its_run(runs: list[Run]) -> None:
    file = runs[1].tables / "frames" / "iteration-000001.parquet"
    column = pq.read_metadata(file).row_group(0).column(schema.FRAMES.get_field_index("cost"))
    content = bytearray(file.read_bytes())
    content[column.data_page_offset + column.total_compressed_size - 3] ^= 1
    file.write_bytes(content)
    with pytest.raises(DataError, match=r"run rough-a is not whole: table frames .*restore"):
        query(Question(runs, "SELECT sum(cost) AS cost FROM frames", left_out=pytest.fail))


@pytest.mark.parametrize("table", ["frames", "nothing"])
def test_no_text_that_sql_raises_counts_as_damage(runs: list[Run], table: str) -> None:
    sql = f"SELECT error('reading the stream registered as ''{table}'' failed: ' || run) FROM frames"
    with pytest.raises(QueryError, match="reading the stream registered as"):
        query(Question(runs, sql))


def test_a_pattern_finds_runs_and_a_wrong_one_the_nearest(runs: list[Run]) -> None:
    root = runs[0].path.parent
    assert catalog.matching(root, "rough-*") == runs[1:]
    assert catalog.matching(root, "[fr]*-a") == [runs[1]]
    assert catalog.matching(root, "flat") == [runs[0]]
    with pytest.raises(RunError, match=r"matches 'rouhg-\*'; the closest: rough-.*; runs: flat, rough-a, rough-b"):
        catalog.matching(root, "rouhg-*")
    with pytest.raises(RunError, match="holds no runs"):
        catalog.matching(root / "none", "*")


def test_a_parameter_is_a_value_and_never_sql(runs: list[Run]) -> None:
    values = {"a": 3, "b": 0.5, "c": "it's', --", "d": True, "e": [1, 2]}
    names = ", ".join(f"${name} AS {name}, typeof(${name}) AS {name}_kind" for name in values)
    (row,) = query(Question(runs[:1], f"SELECT {names}", values)).to_pylist()
    assert {name: row[name] for name in values} == values
    assert [row[f"{name}_kind"] for name in values] == ["INTEGER", "DOUBLE", "VARCHAR", "BOOLEAN", "INTEGER[]"]


@pytest.mark.parametrize(
    ("sql", "given", "words"),
    [
        ("SELECT $a + $b", {"a": 1}, ["$b has no value", "$a, $b", "--param"]),
        ("SELECT 1", {"a": 1}, ["the value a is not used", "none"]),
        ("SELECT '$a', ?", {}, ["$1 has no value"]),
    ],
)
def test_parameters_are_those_of_the_sql(runs: list[Run], sql: str, given: dict[str, object], words: list[str]) -> None:
    with pytest.raises(QueryError) as refused:
        query(Question(runs[:1], sql, given))
    for word in words:
        assert word in str(refused.value)


def test_a_parquet_file_is_the_result(runs: list[Run]) -> None:
    sink = io.BytesIO()
    question = Question(runs, "SELECT run, step, nodes FROM frames ORDER BY ALL")
    write(question, "parquet", sink)
    assert pq.read_table(pa.BufferReader(sink.getvalue())).equals(query(question))


@pytest.mark.parametrize(
    ("sql", "read"),
    [
        ("SELECT 1", set()),
        ("select * from EPISODES", {"episodes"}),
        ("SELECT * FROM speed_by_class", {"frames", "runs"}),
        ("SELECT * FROM learning_curves", {"iterations", "runs"}),
        ("SELECT * FROM query_table('fra' || 'mes')", {*schema.TABLES, "runs"}),
    ],
)
def test_what_sql_may_read_is_what_it_names(sql: str, read: set[str]) -> None:
    assert views.read_by(sql) == read


@pytest.mark.slow
def test_hundreds_of_files_fit_into_the_bounds(runs: list[Run]) -> None:
    many = [catalog.copy(runs[2], runs[2].path.parent, f"copy-{number}") for number in range(60)]
    found = query(Question(many, "SELECT count(DISTINCT run) AS runs, count(*) AS n, sum(cost) AS cost FROM frames"))
    (row,) = found.to_pylist()
    assert (row["runs"], row["n"]) == (60, 60 * 54)
