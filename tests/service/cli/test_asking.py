"""Laws of `t6gps query` over many runs, of its files and parameters, and of `t6gps schema`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.service.api import asking
from t6gps.storage import catalog, schema
from t6gps.storage.sql import views

SQL = "SELECT run, episode_id, cost FROM episodes WHERE cost > $least ORDER BY ALL"


@pytest.fixture(scope="module")
def root(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two whole runs, and one whose settings and frames are damaged."""
    root = tmp_path_factory.mktemp("asking")
    for name in ("rough-0", "rough-1", "rough-broken"):
        catalog.copy(tiny.run, root, name)
    (root / "rough-broken" / "config.json").write_text("{")
    (root / "rough-broken" / "tables" / "frames" / "iteration-000001.parquet").unlink()
    return root


@pytest.mark.parametrize("end", ["parquet", "arrow", "csv", "json"])
def test_a_file_holds_what_is_asked_of_many_runs(end: str, root: Path, tmp_path: Path) -> None:
    (tmp_path / "question.sql").write_text(SQL)
    out = tmp_path / f"answer.{end}"
    arguments = ("--file", tmp_path / "question.sql", "--param", "least=0", "--out", out, "--root", root)
    done = t6gps("query", "rough-*", *arguments)
    assert done.stdout.decode() == f"{out}\n"
    assert done.stderr.startswith("warning: left out: run rough-broken is not whole")
    read = {
        "parquet": pq.read_table,
        "arrow": lambda file: pa.ipc.open_stream(file.read_bytes()).read_all(),
        "csv": pyarrow.csv.read_csv,
        "json": lambda file: pa.Table.from_pylist(json.loads(file.read_text())),
    }
    rows = read[end](out).to_pylist()
    assert [(row["run"], row["episode_id"]) for row in rows] == [
        (f"rough-{run}", episode) for run in range(2) for episode in range(9)
    ]
    assert {path.name for path in tmp_path.iterdir()} == {"question.sql", out.name}


def test_sql_comes_from_the_standard_input(root: Path) -> None:
    asked = "SELECT run, robot_friction, evaluation_cost > 0 AS done FROM runs"
    command = [sys.executable, "-m", "t6gps", "query", "rough-?", "-", "--format=csv", f"--root={root}"]
    done = subprocess.run(command, input=asked, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        '"run","robot_friction","done"',
        '"rough-0",1,true',
        '"rough-1",1,true',
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["rough-0"], ["either SQL or --file"]),
        (["rough-0", "SELECT 1", "--file", "x.sql"], ["either SQL or --file"]),
        (["rough-0", "--file", "none.sql"], ["cannot read SQL from none.sql"]),
        (["rough-0", "SELECT 1", "--out", "x.xls"], ["FILE.parquet", "x.xls"]),
        (["rough-0", "SELECT 1", "--out", "x.csv", "--format", "csv"], ["leave out --format"]),
        (["rough-0", "SELECT 1", "--out", "none/x.csv"], ["cannot write none/x.csv"]),
        (["rough-0", "SELEC 1", "--out", "x.csv"], ["SELEC"]),
        (["rough-0", "SELECT $a", "--param", "a"], ["NAME=VALUE", "'a'"]),
        (["rough-0", "SELECT $a", "--param", "a={b=1}"], ["--param a takes a number"]),
        (["rough-0", "SELECT $a", "--param", "a=1", "--param", "a=2"], ["--param a is given twice: 1, then 2"]),
        (["rough-0", ""], ["SELECT"]),
        (["rough-0", "SELECT $a"], ["$a has no value"]),
        (["rouhg-*", "SELECT 1"], ["the closest: rough-"]),
        (["rough-broken", "SELECT run FROM runs"], ["run rough-broken is not whole"]),
    ],
)
def test_what_cannot_be_asked_is_one_error_and_leaves_no_file(
    arguments: list[str], words: list[str], root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = t6gps("query", *arguments, "--root", root, code=2)
    assert done.stderr.startswith("error: ")
    for word in words:
        assert word in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_by_a_whole_one(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "answer.csv"
    out.write_text("before")
    t6gps("query", "rough-0", "SELECT 'x'::INT", "--out", out, "--root", root, code=2)
    assert out.read_text() == "before"
    t6gps("query", "rough-0", "SELECT 1 AS n", "--out", out, "--root", root)
    assert out.read_text() == '"n"\n1\n'


def test_schema_tells_type_unit_and_meaning_of_every_column() -> None:
    rows = json.loads(t6gps("schema", "--json").stdout)
    tables = views.asked(asking.ABOUT.columns)
    assert [(row["table_name"], row["column_name"]) for row in rows] == [
        (table, column) for table, definition in tables.items() for column in definition.names
    ]
    printed = t6gps("schema", "frames").stdout.decode()
    assert all(name in printed for name in ["run", *schema.FRAMES.names])
    wrong = t6gps("schema", "segment", code=2)
    assert "did you mean segments?" in wrong.stderr


def test_every_setting_is_a_column_of_runs(tiny: Trained) -> None:
    row = asking.ABOUT.row(tiny.run)
    assert next(iter(row)) == "run"
    for section, settings in tiny.config.model_dump(mode="json").items():
        for name, value in settings.items():
            if not isinstance(value, dict):
                assert row[f"{section}_{name}"] == value, name
    assert row["learner_action_value_discount"] == tiny.config.learner.action_value.discount
    assert tiny.config.run.seed == row["seed"] == row["run_seed"]
