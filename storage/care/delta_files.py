"""A table of a run as it lies on disk: its log has no gap, and each of its files is there with every page as written.

Files are read a row group at a time. Of each row stays what other tables refer to, of frames one row per episode.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from t6gps.storage import durable, schema
from t6gps.storage.care import commits
from t6gps.storage.care.fault import Fault, within
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, parquet, policies
from t6gps.storage.errors import DataError
from t6gps.storage.objects import place

KEYS = {
    "frames": ("iteration", "episode_id", "step", "policy_version"),
    "episodes": ("iteration", "episode_id", "steps", "policy_version"),
    "iterations": ("iteration", "policy_version", "episodes", "steps"),
    "classes": ("iteration",),
    "models": ("iteration",),
    "policies": ("iteration", "version", "parent"),
    "evaluations": ("evaluation_id", "policy_version", "episodes"),
    "evaluation_episodes": ("evaluation_id", "episode_id", "steps", "policy_version"),
    "evaluation_frames": ("evaluation_id", "episode_id", "step", "policy_version"),
}
"""Columns by which tables refer to each other."""
SUMMED_SINCE = 7
"""The version of the tables since which each commit has the SHA-256 of its file and the number of its rows."""
_NUMBER = re.compile(r"(?:iteration|evaluation)-(\d{6})\.parquet")


@dataclass(frozen=True)
class Entry:
    """A file of a table: what the commit in its log says of it. Commits of earlier versions have no SHA-256.

    ranges    least and largest entry of columns, by which readers skip files
    lacking   what the commit has not, and one of this version has
    """

    path: Path
    size: int
    rows_n: int | None
    sha256: str | None
    ranges: dict[str, tuple[int, int]]
    lacking: str | None = None

    @property
    def number(self) -> int | None:
        """Of its iteration or evaluation."""
        return number_of(self.path.name)


@dataclass
class Found:
    """A table as far as it could be read.

    committed_n   files that its log has had
    files         those that it has now
    keys          by file, the columns KEYS of its rows; of frames, a row for each episode with its `frames`
    faults        what is wrong
    """

    table: str
    committed_n: int = 0
    files: list[Entry] = field(default_factory=list)
    keys: dict[str, pa.Table] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)


def number_of(name: str) -> int | None:
    """The iteration or evaluation whose rows a file of that name holds."""
    matched = _NUMBER.fullmatch(name)
    return int(matched[1]) if matched else None


def opened(run: Run, table: str) -> Found:
    """What the log of a table says, and what is wrong with the log."""
    written = commits.read(run, table)
    found = Found(table, faults=written.faults)
    if found.faults:
        return found
    try:
        delta = log.opened(run, table)
        if delta is None:
            return found
        with log.readable(run, table):
            actions = pa.table(delta.get_add_actions(flatten=True)).sort_by("path").to_pylist()
            wrong = parquet.differs(table, pa.schema(delta.schema().to_arrow()))
    except DataError as error:
        wrong = str(error)
    else:
        found.committed_n = log.committed(delta)
        found.files = [_entry(run, table, row, written) for row in actions]
    if wrong is not None:
        where = within(run, written.newest or run.tables / table / "_delta_log")
        found.faults.append(Fault(table, where, wrong, repairable=True))
    return found


def _entry(run: Run, table: str, action: Mapping[str, Any], written: commits.Commits) -> Entry:
    path = action["path"]
    ranges = {name: (action.get(f"min.{name}"), action.get(f"max.{name}")) for name in log.IDENTITIES}
    return Entry(
        run.tables / table / path,
        action["size_bytes"],
        action.get("num_records"),
        written.sums.get(path),
        {name: (least, most) for name, (least, most) in ranges.items() if least is not None and most is not None},
        written.lacking.get(path),
    )


def examine(run: Run, found: Found, entry: Entry) -> None:
    """Read a file whole, every page against its CRC-32; keep its keys, or say what is wrong.

    A file that has the SHA-256 of its commit is as it was written, so that what contradicts it is the log. StoreError
    where its object store does not answer.
    """
    try:
        sound = _as_written(entry)
        keys, version = _keys(found.table, entry)
        wrong = _contradicted(entry, keys)
        if wrong is not None and not sound:
            raise ValueError(wrong)
        if entry.lacking is not None and version >= SUMMED_SINCE:
            wrong = f"its log has no {entry.lacking}"
        kept = _by_episode(keys) if "frames" in found.table else keys
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError, DataError) as error:
        place.answers(entry.path, error)
        what = (str(error).splitlines() or [type(error).__name__])[0][: log.MESSAGE_LENGTH_N]
        found.faults.append(Fault(found.table, within(run, entry.path), what, entry.number))
    else:
        if wrong is not None:
            log_of = f"tables/{found.table}/_delta_log"
            what = f"of {entry.path.name} {wrong.removeprefix('its log ')}, and the file is whole by itself"
            found.faults.append(Fault(found.table, log_of, what, entry.number, repairable=True))
        found.keys[entry.path.name] = kept


def _as_written(entry: Entry) -> bool:
    """True where a file has the SHA-256 that its commit has, False where that has none; ValueError where it has not."""
    if not entry.path.exists():
        raise ValueError("it is missing")
    if entry.sha256 == durable.sha256(entry.path):
        return True
    wrong = _size(entry)
    if wrong is None and entry.sha256 is not None:
        wrong = "its SHA-256 is another than its log has"
    if wrong is not None:
        raise ValueError(wrong)
    return False


def _size(entry: Entry) -> str | None:
    size = entry.path.stat().st_size
    return None if size == entry.size else f"its log has {entry.size} bytes, found {size}"


def _contradicted(entry: Entry, keys: pa.Table) -> str | None:
    """What a commit has of a file that it does not have."""
    size = _size(entry)
    if size is not None:
        return size
    if entry.rows_n not in (None, keys.num_rows):
        return f"its log has {entry.rows_n} rows, found {keys.num_rows}"
    for name, ends in entry.ranges.items():
        there = pc.min_max(keys.column(name)).as_py()
        if ends != (there["min"], there["max"]):
            return f"its log has {ends[0]} .. {ends[1]} for {name}, found {there['min']} .. {there['max']}"
    return None


def _keys(table: str, entry: Entry) -> tuple[pa.Table, int]:
    """The keys of a file that is whole by itself, and its schema version; else some error."""
    with pq.ParquetFile(place.source(entry.path), page_checksum_verification=True) as file:
        wrong = parquet.differs(table, file.schema_arrow)
        if wrong is not None:
            raise ValueError(wrong)
        groups = [schema.TABLES[table].empty_table().select(KEYS[table])]
        for number in range(file.num_row_groups):
            rows = file.read_row_group(number)
            if table == "policies":
                for row in rows.to_pylist():
                    policies.policy(row)  # against its SHA-256
            groups.append(rows.select(KEYS[table]))
        version = parquet.version_of(file.schema_arrow)
    return pa.concat_tables(group.replace_schema_metadata(None).cast(_bare(table)) for group in groups), version


def _bare(table: str) -> pa.Schema:
    """The keys' types alone: units and whether null is allowed may differ between versions."""
    return pa.schema([(name, schema.TABLES[table].field(name).type) for name in KEYS[table]])


def _by_episode(keys: pa.Table) -> pa.Table:
    """A row for each stretch of an episode's frames, and how many there are. ValueError for steps out of order."""
    numbers, steps = keys.column("episode_id").to_numpy(), keys.column("step").to_numpy()
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 1))
    lengths = np.diff(starts, append=len(steps))
    wrong = np.flatnonzero(steps != np.arange(len(steps)) - np.repeat(starts, lengths))
    if len(wrong):
        raise ValueError(f"the frames of episode {numbers[wrong[0]]} are not those of steps 0 .. T in order")
    return keys.take(starts).drop_columns("step").append_column("frames", pa.array(lengths))


def begun_with(found: Found) -> int | None:
    """The schema version of the oldest file, None where it cannot be read."""
    for entry in found.files[:1]:
        try:
            return parquet.version(str(entry.path))
        except (pa.ArrowException, OSError):
            return None
    return None


def rows(found: Found) -> Iterator[dict[str, int | None]]:
    """The keys of all rows."""
    for keys in found.keys.values():
        yield from keys.to_pylist()
