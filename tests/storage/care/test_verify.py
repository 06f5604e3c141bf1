"""Laws of verifying: every planted damage is found where it is, and a sound run has none, at work or of old."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from t6gps.storage import catalog, durable, schema, tables
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.spool import Spool


def flip(file: Path, place: int) -> None:
    """Change one bit of a file."""
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.write_bytes(content)


def rewrite(run: Run, table: str, number: int, change: Callable[[pa.Table], pa.Table], digest: bool = True) -> None:
    """Change the rows of a file and its commit with it, so that the table is whole by itself."""
    file = run.tables / table / f"iteration-{number:06d}.parquet"
    rows = change(pq.read_table(file))
    pq.write_table(rows, file)
    commit = run.tables / table / "_delta_log" / f"{number + 1:020d}.json"
    actions = [json.loads(line) for line in commit.read_text().splitlines()]
    for action in actions:
        if "commitInfo" in action:
            del action["commitInfo"][log.SHA256]
            action["commitInfo"] |= {log.SHA256: durable.sha256(file)} if digest else {}
        if "add" in action:
            action["add"] |= {"size": file.stat().st_size, "stats": json.dumps({"numRecords": rows.num_rows})}
    commit.write_text("\n".join(map(json.dumps, actions)))


def with_column(rows: pa.Table, name: str, value: object) -> pa.Table:
    """The rows, one of whose columns holds a value in its first row."""
    place = rows.schema.get_field_index(name)
    values = [value, *rows.column(name).to_pylist()[1:]]
    return rows.set_column(place, rows.schema.field(name), pa.array(values, rows.schema.field(name).type))


def commit_of(table: str, number: int) -> str:
    return f"tables/{table}/_delta_log/{number:020d}.json"


DAMAGES: dict[str, tuple[str, Callable[[Run], object]]] = {
    "a bit of a page": ("frames", lambda run: flip(run.tables / "frames" / "iteration-000001.parquet", 2000)),
    "a bit of a footer": ("classes", lambda run: flip(run.tables / "classes" / "iteration-000001.parquet", -60)),
    "half a file": ("models", lambda run: os.truncate(run.tables / "models" / "iteration-000000.parquet", 400)),
    "no file": ("episodes", lambda run: (run.tables / "episodes" / "iteration-000002.parquet").unlink()),
    "gap in a log": ("iterations", lambda run: (run.path / commit_of("iterations", 1)).unlink()),
    "torn commit": ("policies", lambda run: os.truncate(run.path / commit_of("policies", 2), 60)),
    "end of a log": ("classes", lambda run: (run.path / commit_of("classes", 3)).unlink()),
    "end of the last log": ("episodes", lambda run: (run.path / commit_of("episodes", 3)).unlink()),
    "no table": ("evaluation_frames", lambda run: shutil.rmtree(run.tables / "evaluation_frames")),
    "a frame too few": ("frames", lambda run: rewrite(run, "frames", 1, lambda rows: rows.slice(0, rows.num_rows - 1))),
    "frames out of order": (
        "frames",
        lambda run: rewrite(run, "frames", 1, lambda rows: rows.take([1, 0, *range(2, rows.num_rows)])),
    ),
    "an episode too few": ("episodes", lambda run: rewrite(run, "episodes", 2, lambda rows: rows.slice(1))),
    "a count that is wrong": (
        "episodes",
        lambda run: rewrite(run, "iterations", 1, lambda rows: with_column(rows, "episodes", 4)),
    ),
    "a policy that is not there": (
        "iterations",
        lambda run: rewrite(run, "iterations", 1, lambda rows: with_column(rows, "policy_version", 9)),
    ),
    "a weight": (
        "policies",
        lambda run: rewrite(run, "policies", 2, lambda rows: with_column(rows, "weights", [0.25] * 30)),
    ),
    "classes of no iteration": (
        "classes",
        lambda run: rewrite(run, "classes", 2, lambda rows: with_column(rows, "iteration", 7)),
    ),
    "a checkpoint": ("checkpoints", lambda run: flip(run.checkpoints / "iteration-000003" / "arrays.npz", 40)),
    "no mark of a checkpoint": ("checkpoints", lambda run: (run.checkpoints / "iteration-000002" / "DONE").unlink()),
    "a spooled episode": ("spool", lambda run: os.truncate(Spool(run.spool, 3).path(300), 999)),
}


@pytest.fixture
def spooled(worked: Run, make_episode: Any) -> Run:
    """The run `worked` with an episode of its next iteration."""
    Spool(worked.spool, 3).append(make_episode(300, 3))
    return worked


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_planted_damage_is_found_in_its_part_and_nowhere_else(spooled: Run, damage: str) -> None:
    assert verify(spooled) == []
    part, plant = DAMAGES[damage]
    plant(spooled)
    faults = verify(spooled)
    assert {fault.part for fault in faults} == {part}
    assert faults[0].place.startswith("tables" if part in schema.TABLES else part)
    assert "\n" not in str(faults[0])


def test_any_bit_of_a_tables_file_that_has_changed_is_found(worked: Run) -> None:
    file = worked.tables / "iterations" / "iteration-000001.parquet"
    whole = file.read_bytes()
    for place in range(0, len(whole), len(whole) // 9):
        flip(file, place)
        assert [fault.part for fault in verify(worked)] == ["iterations"], place
        file.write_bytes(whole)


def test_an_empty_run_a_cut_off_commit_and_a_policy_without_tables_are_sound(
    run: Run, commit_cut_off: Any, worked: Run
) -> None:
    assert verify(run) == []
    shutil.copytree(worked.checkpoints, run.checkpoints, dirs_exist_ok=True)
    for path in run.checkpoints.iterdir():  # as that of a baseline
        manifest = path / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"ledger"', '"other"'))
        (path / "DONE").write_text(durable.sha256(manifest))
    assert verify(run) == []
    commit_cut_off(worked, 3, "frames classes", "models")
    assert verify(worked) == []


def test_a_run_that_works_meanwhile_has_no_fault(worked: Run, iterate: Any, evaluate: Any) -> None:
    ended = Event()

    def work() -> None:
        for number in range(3, 8):
            iterate(worked, number)
            evaluate(worked, number)
        ended.set()

    working, rounds_n = Thread(target=work), 0
    working.start()
    while not ended.is_set() and working.is_alive():
        assert verify(worked) == []
        rounds_n += 1
    working.join()
    assert ended.is_set() and rounds_n > 1
    assert verify(worked) == []
    assert tables.committed_iterations(worked) == 8


LATER = {"iterations": {1: 5, 2: 2, 3: 1, 4: 1}, "classes": {1: 3}, "frames": dict.fromkeys(range(1, 6), 2)}
"""How many columns of a table a version had not."""


@pytest.mark.parametrize("version", range(1, 6))
def test_runs_of_earlier_versions_have_no_fault(tmp_path: Path, iterate: Any, version: int) -> None:
    """They lack tables and columns, their commits have no digests, and their pages no sums."""
    run = catalog.create(tmp_path, "old", "{}")
    iterate(run, 0)
    for name in schema.OF_ITERATIONS:
        if name in schema.YOUNGER:
            shutil.rmtree(run.tables / name)
            continue
        lacking_n = LATER.get(name, {}).get(version, 0)
        rewrite(run, name, 0, lambda rows, n=lacking_n: rows.select(rows.column_names[: rows.num_columns - n])
                .replace_schema_metadata({"t6gps_schema_version": str(version)}), digest=False)  # fmt: skip
    assert verify(run) == []
    iterate(run, 1)
    assert verify(run) == []
    os.truncate(run.tables / "episodes" / "iteration-000000.parquet", 100)
    assert {fault.part for fault in verify(run)} == {"episodes"}
