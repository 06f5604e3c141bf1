"""Damages that tests plant into a run of three iterations, with the part of the run that each is found in."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.spool import Spool

DEEP = "[" * 100_000
"""More brackets than a reader's stack holds."""


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


def as_file(folder: Path) -> None:
    """Leave a file where a folder was."""
    shutil.rmtree(folder)
    folder.write_text("lost")


def commit_of(table: str, number: int) -> str:
    return f"tables/{table}/_delta_log/{number:020d}.json"


def alter(run: Run, table: str, number: int, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what the commit of a file says of it; the file stays as it is."""
    commit = run.path / commit_of(table, number + 1)
    actions = [json.loads(line) for line in commit.read_text().splitlines()]
    for action in actions:
        if "add" in action:
            change(action["add"])
    commit.write_text("\n".join(map(json.dumps, actions)))


def unsaid(run: Run) -> None:
    """Take from a commit the SHA-256 of its file."""
    commit = run.path / commit_of("models", 2)
    actions = [json.loads(line) for line in commit.read_text().splitlines()]
    for action in actions:
        action.get("commitInfo", {}).pop(log.SHA256, None)
    commit.write_text("\n".join(map(json.dumps, actions)))


def _stats(add: dict[str, Any], **changed: object) -> None:
    add["stats"] = json.dumps(json.loads(add["stats"]) | changed)


ALTERED: dict[str, Callable[[dict[str, Any]], object]] = {
    "size": lambda add: add.update(size=add["size"] + 1),
    "rows": lambda add: _stats(add, numRecords=7),
    "range": lambda add: _stats(add, minValues={"iteration": 0}, maxValues={"iteration": 9}),
    "statistics that are none": lambda add: add.update(stats="[1]"),
    "statistics that are null": lambda add: add.update(stats=None),
    "rows left out": lambda add: add.update(
        deletionVector={"storageType": "u", "pathOrInlineDv": "x", "sizeInBytes": 1, "cardinality": 1}
    ),
}
"""What may be wrong in a commit whose file is as it was."""
DAMAGES: dict[str, tuple[str, Callable[[Run], object]]] = {
    "a bit of a page": ("frames", lambda run: flip(run.tables / "frames" / "iteration-000001.parquet", 2000)),
    "a bit of a footer": ("classes", lambda run: flip(run.tables / "classes" / "iteration-000001.parquet", -60)),
    "half a file": ("models", lambda run: os.truncate(run.tables / "models" / "iteration-000000.parquet", 400)),
    "no file": ("episodes", lambda run: (run.tables / "episodes" / "iteration-000002.parquet").unlink()),
    "gap in a log": ("iterations", lambda run: (run.path / commit_of("iterations", 1)).unlink()),
    "torn commit": ("policies", lambda run: os.truncate(run.path / commit_of("policies", 2), 60)),
    **{
        f"a commit's {name}": ("frames", lambda run, change=change: alter(run, "frames", 1, change))
        for name, change in ALTERED.items()
    },
    "no digest in a commit": ("models", unsaid),
    "a commit of brackets": ("models", lambda run: (run.path / commit_of("models", 2)).write_text(DEEP)),
    "no tables": ("episodes", lambda run: shutil.rmtree(run.tables)),
    "empty tables": ("episodes", lambda run: [shutil.rmtree(table) for table in run.tables.iterdir()]),
    "a file named tables": ("episodes", lambda run: as_file(run.tables)),
    "a file named as a table": ("models", lambda run: as_file(run.tables / "models")),
    "a file named as a log": ("models", lambda run: as_file(run.tables / "models" / "_delta_log")),
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
