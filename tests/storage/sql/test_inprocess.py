"""Laws of SQL in this process: the answers and the errors of the sandbox, of what is committed now."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import pytest
import synthetic

from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, QueryError, T6GpsError
from t6gps.storage.sql import inprocess
from t6gps.storage.sql.inprocess import InProcess
from t6gps.storage.sql.query import Question, query

SUMS = "SELECT iteration, sum(cost) AS cost, count(*) AS n FROM frames GROUP BY iteration ORDER BY iteration"


def words(ask: Any, question: Question) -> tuple[type[Exception], str]:
    with pytest.raises(T6GpsError) as refused:
        ask(question)
    return type(refused.value), str(refused.value)


def test_an_answer_is_that_of_the_sandbox_and_knows_each_new_commit(run: Run, commit: Any) -> None:
    for iteration in range(3):
        commit(run, iteration)
        found = inprocess.ask(Question([run], SUMS))
        assert found.column("n").to_pylist() == [18] * (iteration + 1)
        there = query(Question([run], SUMS))
        assert found.drop_columns("cost").equals(there.drop_columns("cost"))
        assert found["cost"].to_pylist() == pytest.approx(there["cost"].to_pylist(), rel=1e-12)
        assert inprocess.ask(Question([run], SUMS)).equals(found), "to the last bit"
    sql = "SELECT s.*, r.run, $a AS a FROM segments s JOIN runs r USING (run) ORDER BY ALL"
    assert inprocess.ask(Question([run], sql, {"a": 3})).equals(query(Question([run], sql, {"a": 3})))


def test_a_run_that_was_replaced_under_its_name_is_the_new_one(run: Run, commit: Any) -> None:
    totals = []
    for change in (commit, synthetic.commit):
        shutil.rmtree(run.path)
        made = catalog.create(run.path.parent, run.name, "{}")
        change(made, 0)
        (total,) = inprocess.ask(Question([made], "SELECT sum(cost) AS cost FROM frames"))["cost"].to_pylist()
        assert total == pytest.approx(pc.sum(tables.read(made, "frames")["cost"]).as_py())
        totals.append(total)
    assert totals[0] != pytest.approx(totals[1])


@pytest.mark.parametrize(
    ("sql", "parameters"),
    [
        ("SELECT cots FROM frames", {}),
        ("SELECT * FROM frame", {}),
        ("DROP TABLE frames", {}),
        ("COPY (SELECT 1) TO '/tmp/stolen'", {}),
        ("SELECT * FROM read_csv('/etc/passwd')", {}),
        ("SELECT * FROM run", {}),
        ("SELECT 1; SELECT 2", {}),
        ("SELECT $a", {}),
        ("SELECT 'a'::INT", {}),
        ("SELECT " + "(" * 101 + "1" + ")" * 101, {}),
        ("SELECT 1::UHUGEINT", {}),
    ],
)
def test_what_is_refused_is_refused_in_the_words_of_the_sandbox(
    run: Run, sql: str, parameters: dict[str, object]
) -> None:
    question = Question([run], sql, parameters)
    assert words(inprocess.ask, question) == words(query, question)
    assert words(inprocess.ask, question)[0] is QueryError


def test_damage_names_the_run_and_is_found_again_when_it_is_mended(run: Run, commit: Any) -> None:
    commit(run, 0)
    assert inprocess.ask(Question([run], SUMS)).num_rows == 1
    file = run.tables / "frames" / "iteration-000000.parquet"
    whole = file.read_bytes()
    for damaged in (whole[:-100], whole[:300] + bytes(100) + whole[400:]):
        file.write_bytes(damaged)
        kind, sentence = words(inprocess.ask, Question([run], "SELECT * FROM frames"))
        assert kind is DataError
        assert "run trial is not whole: table frames" in sentence
    file.write_bytes(whole)
    assert inprocess.ask(Question([run], SUMS)).num_rows == 1


def test_results_are_read_side_by_side_and_engines_travel_empty(run: Run, commit: Any) -> None:
    commit(run, 0)
    engines = pickle.loads(pickle.dumps(InProcess()))
    rows = Question([run], "SELECT * FROM range(50000) ORDER BY ALL")
    with engines.answered(rows) as one, engines.answered(rows) as other:
        pairs = list(zip(one, other, strict=True))
    assert len(pairs) > 1
    assert all(a.equals(b) for a, b in pairs)


def test_nothing_is_written_where_the_data_are(run: Run, commit: Any, tmp_path: Path) -> None:
    commit(run, 0)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    inprocess.ask(Question([run], "SELECT * FROM frames f, range(200) ORDER BY hash(f.step, range)"))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
