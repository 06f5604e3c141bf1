"""What queries over many runs need of each, kept below the root: ROOT/.cache/NAME/KEY.

A run has a table's file for each iteration, and logs to read before them. An entry of the cache has the
names of all files, and the rows of small tables in one file. Its KEY covers name, size, times and inode of everything
in RUN/tables, so an entry of other tables is never found. It may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from t6gps.storage import durable, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, parquet
from t6gps.storage.delta.parquet import Files
from t6gps.storage.errors import DataError
from t6gps.storage.objects import place

TABLES = ("episodes", "iterations")
"""Tables whose rows an entry holds: the small ones of many files that questions over many runs ask."""

_log = logging.getLogger(__name__)
_INDEX = "index.json"
_FORMAT_VERSION = 2
_CLOCK_STEP_NS = 2 * 10**9
"""Two changes of a file within less may have the same time, on the coarsest of file systems."""


@dataclass(frozen=True)
class Whole:
    """A run without damage.

    done     iterations that are committed
    newest   the row of the last one in `iterations`; empty before the first
    files    those of each table
    """

    done: int
    newest: Mapping[str, int | float | None]
    files: Mapping[str, Files]


def whole(run: Run) -> Whole:
    """What there is to know of a run, from the cache where that has it. DataError where a table is damaged."""
    if place.is_object(run.path):
        return _read(run)
    return _kept(run) or _entered(run) or _read(run)


def files(run: Run, names: Collection[str]) -> dict[str, Files]:
    """The files of tables, as `tables.files`; those of TABLES may be one with the rows of all."""
    if place.is_object(run.path):
        return tables.files(run, names)
    try:
        found = whole(run).files
    except DataError:  # perhaps in another table
        return tables.files(run, names)
    return {name: found[name] for name in names}


def forget_torn(runs: Iterable[Run]) -> bool:
    """Remove entries that lack a file by now, or have a damaged one; True where there were any."""
    torn = [run for run in runs if not place.is_object(run.path) and _is_torn(run)]
    for run in torn:
        shutil.rmtree(run.cache, ignore_errors=True)  # somebody else may be at it, too
    return bool(torn)


@dataclass(frozen=True)
class _State:
    """Tables of a run as they lie on disk: a key of all their files, and when the last of them changed."""

    key: str
    changed_ns: int
    device: int


def _state(run: Run) -> _State | None:
    """None where files come and go meanwhile, or may not be read."""
    digest, changed_ns = hashlib.sha256(f"{_FORMAT_VERSION} {schema.SCHEMA_VERSION}".encode()), 0
    try:
        for path, stat in sorted(_stats(run.tables)):
            digest.update(f"{path}\0{stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns} {stat.st_ino}\n".encode())
            changed_ns = max(changed_ns, stat.st_mtime_ns, stat.st_ctime_ns)
        return _State(digest.hexdigest()[:32], changed_ns, run.tables.stat().st_dev)
    except OSError:
        return None


def _stats(folder: Path | str, below: str = "") -> Iterator[tuple[str, os.stat_result]]:
    """The paths of all files below a folder, with what the file system says of each."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _stats(entry.path, f"{below}{entry.name}/")
            else:
                yield below + entry.name, entry.stat()


def _kept(run: Run) -> Whole | None:
    """What the entry says that is of the tables as they are, None where there is none."""
    state = _state(run)
    if state is None:
        return None
    entry = run.cache / state.key
    try:
        index = durable.parsed((entry / _INDEX).read_bytes())
    except (OSError, ValueError):
        return None
    files = {
        table: Files([f"{run.tables}/{path}" for path in found["paths"]], found["iterations_n"])
        for table, found in index["files"].items()
    }
    return Whole(index["done"], index["newest"], files | {name: Files([str(_file(entry, name))]) for name in TABLES})


def _entered(run: Run) -> Whole | None:
    """What the tables say, which becomes an entry; None where that cannot be written, or the tables are changing."""
    try:
        run.cache.mkdir(parents=True, exist_ok=True)
        with durable.draft(run.cache / "entry") as draft:
            state, now = _state(run), draft.stat()  # of which the draft is the older one
            settled = state is not None and state.changed_ns + _CLOCK_STEP_NS < now.st_mtime_ns
            if state is None or not settled or state.device != now.st_dev:
                return None
            found = _read(run)
            if not found.done:  # a run whose tables are lost looks as it did then
                return found
            _write(run, draft, found)
            entries = sorted(run.cache.glob("[!.]*"), key=lambda entry: entry.stat().st_mtime)
            for entry in entries[:-1]:  # whoever asked a moment ago may yet read the last one
                durable.discard(entry)
            durable.claim(draft, run.cache / state.key)
            return found
    except OSError as error:
        _log.info("%s: nothing is kept for the next query: %s", run.cache, error)
        return None


def _write(run: Run, entry: Path, found: Whole) -> None:
    for table in TABLES:
        parquet.write(_file(entry, table), schema.TABLES[table], [_rows(run, table, found.files[table])])
    names = {
        table: {
            "paths": [Path(path).relative_to(run.tables).as_posix() for path in of.paths],
            "iterations_n": of.iterations_n,
        }
        for table, of in found.files.items()
    }
    durable.replace(entry / _INDEX, json.dumps({"done": found.done, "newest": found.newest, "files": names}).encode())


def _read(run: Run) -> Whole:
    """What the tables say."""
    found = tables.files(run)
    rows = _rows(run, "iterations", found["iterations"]).sort_by([("iteration", "descending")])[:1].to_pylist()
    newest = rows[0] if rows else {}
    return Whole(newest.get("iteration", -1) + 1, newest, found)


def _rows(run: Run, table: str, found: Files) -> pa.Table:
    with log.readable(run, table):
        return parquet.rows(table, found).to_table()


def _file(entry: Path, table: str) -> Path:
    return entry / f"{table}.parquet"


def _is_torn(run: Run) -> bool:
    try:
        for entry in run.cache.glob("[!.]*"):
            for table in TABLES:
                for _ in parquet.groups(_file(entry, table), schema.TABLES[table].names):
                    pass
    except (OSError, pa.ArrowException):
        return True
    return False
