"""Digests of everything that a run's data hold: `python tests/run_digest.py RUN_FOLDER ...`.

Runs with the same digests hold the same bytes: rows of the tables, whatever their order, arrays of the newest
checkpoint, and evaluations. Durations do not count, nor when and by which commit an evaluation was made: they alone
differ between two runs of one configuration.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa

from t6gps.storage import checkpoint, schema, tables
from t6gps.storage.catalog import Run

ORDER = {
    "frames": ("episode_id", "step"),
    "episodes": ("episode_id",),
    "iterations": ("iteration",),
    "classes": ("iteration", "kind", "entry_edge", "exit_edge", "truncated", "pooled"),
    "models": ("iteration", "bin", "step", "mode"),
    "policies": ("version",),
    "evaluations": ("evaluation_id",),
    "evaluation_episodes": ("evaluation_id", "episode_id"),
    "evaluation_frames": ("evaluation_id", "episode_id", "step"),
}
"""Columns that say in which order the rows of a table count."""
MADE = {("evaluations", "commit"), ("evaluations", "made_at")}
"""Columns that say what made the data."""


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each part of the run in `folder`: its tables, `checkpoint`, and `evaluation` where it has them."""
    run = Run(folder)
    evaluated = tables.read(run, "evaluations").num_rows > 0
    names = schema.TABLES if evaluated else schema.OF_ITERATIONS
    parts = {name: _sum(_table_bytes(run, name)) for name in names}
    latest = checkpoint.load_latest(run.checkpoints)
    if latest is not None:
        iteration, _, arrays = latest
        named = (part for name in sorted(arrays) for part in (name.encode(), arrays[name].tobytes()))
        parts["checkpoint"] = _sum([str(iteration).encode(), *named])
    file = folder / "evaluation.json"
    if file.exists():
        parts["evaluation"] = _sum([file.read_bytes()])
    return parts


def column_bytes(column: pa.ChunkedArray) -> Iterator[bytes]:
    """Which entries there are, how long each is, and their bits: -0.0 differs from 0.0."""
    array = column.combine_chunks()
    yield array.is_valid().to_numpy(zero_copy_only=False).tobytes()
    if pa.types.is_list(array.type):
        yield array.value_lengths().drop_null().to_numpy().tobytes()
        array = array.flatten()
    if pa.types.is_string(array.type):
        yield json.dumps(array.to_pylist()).encode()
    else:
        yield array.drop_null().to_numpy(zero_copy_only=False).tobytes()


def _table_bytes(run: Run, name: str) -> Iterator[bytes]:
    rows = tables.read(run, name).sort_by([(key, "ascending") for key in ORDER[name]])
    for column in rows.column_names:
        duration = name == "iterations" and column.endswith("_s") and not column.endswith("_per_s")
        if not duration and (name, column) not in MADE:
            yield column.encode()
            yield from column_bytes(rows.column(column))


def _sum(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def main() -> None:
    """Print the digest of each part of each run, and of all of them together."""
    for folder in map(Path, sys.argv[1:]):
        parts = digests(folder)
        for name, digest in parts.items():
            print(folder.name, name, digest)
        print(folder.name, "whole", _sum([digest.encode() for digest in parts.values()]))


if __name__ == "__main__":
    main()
