from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from t6gps.storage import catalog, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import QueryError
from t6gps.storage.sql import sandbox, views
from t6gps.storage.sql.query import Question, query, write

PATIENCE_S = 240.0
"""For what is stopped by something else than time, on a busy machine too."""


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return catalog.create(tmp_path_factory.mktemp("runs"), "empty", "{}")


def test_a_query_sees_what_was_committed(run: Run, commit: Any) -> None:
    commit(run, 0)
    commit(run, 1)
    episodes = tables.read(run, "episodes")
    sql = (
        "WITH late AS (SELECT * FROM frames WHERE iteration = 1) "
        "SELECT e.episode_id, e.cost, count(*) AS n, any_value(l.nodes) AS nodes FROM late l JOIN episodes e "
        "USING (episode_id) GROUP BY ALL ORDER BY e.episode_id"
    )
    found = query(Question([run], sql))
    assert found.column("episode_id").to_pylist() == [100, 101, 102]
    assert found.column("cost").to_pylist() == episodes.column("cost").to_pylist()[3:]
    assert found.column("n").to_pylist() == [6, 6, 6]
    assert np.shape(found.column("nodes").to_pylist()) == (3, 36)


def test_a_query_does_not_see_a_commit_that_was_cut_off(run: Run, commit: Any, commit_cut_off: Any) -> None:
    commit(run, 0)
    commit_cut_off(run, 1, "frames classes iterations")
    assert query(Question([run], "SELECT max(iteration) AS last FROM frames")).to_pylist() == [{"last": 0}]


def test_a_run_without_iterations_has_empty_tables_with_every_column(empty: Run) -> None:
    names = [*schema.TABLES, *views.VIEWS]
    counts = ", ".join(f"(SELECT count(*) FROM {name}) AS {name}" for name in names)
    assert query(Question([empty], f"SELECT {counts};")).to_pylist() == [dict.fromkeys(names, 0)]
    listed = query(Question([empty], "SHOW ALL TABLES")).to_pylist()
    assert {row["name"]: row["column_names"] for row in listed} == {
        name: definition.names for name, definition in views.asked().items()
    }
    found = query(Question([empty], "DESCRIBE frames")).column("column_name").to_pylist()
    assert found == ["run", *schema.FRAMES.names]


@pytest.mark.parametrize(
    ("sql", "words"),
    [
        ("SELECT cots FROM frames", ['column "cots" not found', '"cost"', "frames: run, episode_id"]),
        (
            "SELECT e.steeps FROM Episodes e",
            ['column named "steeps"', "did you mean steps?", "episodes: run, episode_id"],
        ),
        ("SELECT * FROM frame", ["name frame does not exist", "did you mean frames?", "frames, episodes, iterations"]),
        ("SELECT avgg(cost) FROM frames", ['Did you mean "avg"?']),
    ],
)
def test_a_wrong_name_is_answered_with_the_nearest_and_what_the_asked_tables_have(
    empty: Run, sql: str, words: list[str]
) -> None:
    with pytest.raises(QueryError) as caught:
        query(Question([empty], sql))
    for word in words:
        assert word in str(caught.value)
    assert "classes: " not in str(caught.value)


def test_a_pivot_is_told_to_name_its_values(empty: Run) -> None:
    with pytest.raises(QueryError, match=r"ON ended_by IN \('completed'\)"):
        query(Question([empty], "PIVOT episodes ON ended_by USING count(*)"))
    named = query(Question([empty], "PIVOT episodes ON ended_by IN ('completed') USING count(*) GROUP BY iteration"))
    assert named.column_names == ["iteration", "completed"]


def test_nothing_is_written_of_a_result_that_fails_at_its_end(empty: Run) -> None:
    sink = io.BytesIO()
    for form in ("arrow", "csv", "json"):
        with pytest.raises(QueryError, match="Conversion Error"):
            write(Question([empty], "SELECT if(range = 90000, 'x', '1')::INT AS n FROM range(100000)"), form, sink)
    assert sink.getvalue() == b""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("COPY (SELECT 1) TO '{file}'", "found COPY"),
        ("EXPORT DATABASE '{file}'", "found EXPORT"),
        ("ATTACH '{file}'", "found ATTACH"),
        ("SET threads = 9", "found SET"),
        ("INSTALL httpfs", "found LOAD"),
        ("PRAGMA database_list", "found PRAGMA"),
        ("CALL pragma_version()", "found CALL"),
        ("CREATE TABLE t AS SELECT 1", "found CREATE"),
        ("WITH a AS (SELECT 1) INSERT INTO frames SELECT * FROM a", "found INSERT"),
        ("SELECT 1; SELECT 2", "found SELECT, SELECT"),
        ("SELECT 1; COPY (SELECT 1) TO '{file}'", "found SELECT, COPY"),
        ("-- nothing", "found nothing"),
        ("SELECT * FROM query('COPY (SELECT 1) TO ''{file}''')", "single SELECT"),
        ("SELECT * FROM read_csv('/etc/passwd')", "disabled by configuration"),
        ("SELECT * FROM glob('/*')", "disabled by configuration"),
        ("SELECT * FROM read_parquet('http://127.0.0.1/x')", "disabled by configuration"),
        ("SELECT * FROM '/etc/passwd'", "does not exist"),
        ("SELECT * FROM files", "does not exist"),
        ("SELEC 1", "syntax error"),
        ("SELECT 'a'::INT", "Conversion Error"),
        ("SELECT " + "NOT " * 16000 + "true", "depth limit"),
    ],
)
def test_an_attack_or_a_mistake_is_refused_with_what_is_allowed(
    empty: Run, tmp_path: Path, sql: str, reason: str
) -> None:
    file = tmp_path / "stolen"
    with pytest.raises(QueryError, match=reason) as caught:
        query(Question([empty], sql.replace("{file}", str(file))))
    assert "allowed is one SELECT" in str(caught.value) or "frames: run, episode_id" in str(caught.value)
    assert not file.exists()


def test_a_query_runs_with_its_bounds_set_and_locked(empty: Run) -> None:
    expected = {
        "enable_external_access": "false",
        "lock_configuration": "true",
        "memory_limit": "953.6 MiB",
        "temp_directory": "",
        "threads": "2",
    }
    found = query(Question([empty], f"SELECT name, value FROM duckdb_settings() WHERE name IN {tuple(expected)}"))
    assert {row["name"]: row["value"] for row in found.to_pylist()} == expected


def test_length_nesting_and_encoding_are_bounded_before_anything_starts(empty: Run) -> None:
    nested = "SELECT " + "(" * 100 + "1" + ")" * 100
    assert query(Question([empty], nested)).num_rows == 1
    for sql, reason in (
        (nested.replace("1", "(1)"), "nests 101 brackets"),
        ("SELECT '" + "é" * 32768 + "'", "65545 bytes"),
        ("SELECT '\ud800'", "not valid Unicode"),
    ):
        with pytest.raises(QueryError, match=reason):
            query(Question([empty], sql, timeout_s=0.0))  # what starts is stopped at once


@pytest.mark.slow
@pytest.mark.parametrize(
    "sql",
    [
        "WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM t) SELECT count(*) FROM t",
        "SELECT sum(sqrt(a.range * b.range)) FROM range(1000000) a, range(1000000) b",
    ],
)
def test_an_endless_query_is_stopped(empty: Run, sql: str) -> None:
    with pytest.raises(QueryError, match=r"stopped after 1\.5 s.*filter"):
        query(Question([empty], sql, timeout_s=1.5))


@pytest.mark.slow
def test_memory_is_bounded(empty: Run) -> None:
    with pytest.raises(QueryError, match=r"(?s)Out of Memory.*filter by iteration") as caught:
        query(Question([empty], "SELECT list(range) FROM range(300000000)", timeout_s=PATIENCE_S))
    assert "SET" not in str(caught.value)


@pytest.mark.slow
def test_memory_beyond_the_reach_of_duckdb_is_bounded_too() -> None:
    script = "from t6gps.storage.sql import sandbox; sandbox.limit(1.0); print(len(bytes({bytes_n})))"
    small, large = (
        subprocess.run(
            [sys.executable, "-c", script.format(bytes_n=bytes_n)], capture_output=True, text=True, check=False
        )
        for bytes_n in (sandbox.MEMORY_BYTES_N // 2, 2 * sandbox.MEMORY_BYTES_N)
    )
    assert small.returncode == 0
    assert "MemoryError" in large.stderr


@pytest.mark.slow
def test_the_result_is_bounded(empty: Run) -> None:
    with pytest.raises(QueryError, match=r"larger than 1 GB.*LIMIT"):
        query(Question([empty], "SELECT range, range AS b, range AS c FROM range(50000000)", timeout_s=PATIENCE_S))


def test_the_process_that_answers_loads_nothing_heavy() -> None:
    source = Path(sandbox.__file__).read_text(encoding="utf-8")
    assert "deltalake" not in source
    script = (
        "import sys, t6gps.storage.sql.sandbox\n"
        "print([name for name in ('torch', 'ray', 'pybullet', 'deltalake') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
