"""A Delta table of a run: files with numbers in turn, each made part of the table by one commit to its log."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable, Schema
from deltalake.exceptions import DeltaError
from deltalake.transaction import AddAction, CommitProperties, PostCommitHookProperties, Transaction

from t6gps.storage import durable, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints, parquet
from t6gps.storage.errors import DataError
from t6gps.storage.objects import place, store

MESSAGE_LENGTH_N = 300
"""Characters of a library's message that are repeated; it may add where in its own code it stopped."""

IDENTITIES = {"iteration", "episode_id", "evaluation_id", "version"}
"""Columns whose ranges the log has, so that readers of Delta tables skip files."""

SHA256 = "sha256"
"""What a commit calls the digest of its file, which covers what no checksum of a page does."""

_COLOUR = re.compile("\x1b\\[[0-9;]*m")
_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")

_NO_HOOKS = PostCommitHookProperties(create_checkpoint=False, cleanup_expired_logs=False)
"""The library would not force to disk what it writes after a commit."""

_APPLICATION = "t6gps"
"""Application id of the Delta transactions; their version is the number of the file."""


def opened(run: Run, table: str) -> DeltaTable | None:
    """A table by its log, None before the first commit. DataError where the log is damaged."""
    folder = run.tables / table
    options = store.delta_options() if place.is_object(run.path) else None
    with readable(run, table):
        return DeltaTable(str(folder), storage_options=options) if _begun(folder / "_delta_log") else None


def _begun(log: Path) -> bool:
    """Whether a log has an entry. The library's own question would stop all threads until an object store answers."""
    try:
        names = place.sizes(log)
    except FileNotFoundError:
        return False
    return any(name.endswith((".json", checkpoints.ENDING)) for name in names)


def state(run: Run) -> tuple[tuple[int | str, ...], ...]:
    """What differs after every commit, and after a file of a table has come, gone, or got another size."""
    if place.is_object(run.path):
        return tuple(place.below(run.tables).items())
    return tuple(_state(run.tables / name) for name in schema.TABLES)


def _state(folder: Path) -> tuple[int, ...]:
    log = folder / "_delta_log"
    try:
        sizes = [entry.stat().st_size for entry in os.scandir(folder) if entry.is_file()]
        return folder.stat().st_mtime_ns, len(sizes), sum(sizes), log.stat().st_mtime_ns, len(list(log.iterdir()))
    except OSError:  # whoever reads the table says why
        return ()


def committed(delta: DeltaTable | None) -> int:
    """How many files have been committed, also by another version of the table: the next has this number."""
    version = None if delta is None else delta.transaction_version(_APPLICATION)
    return 0 if version is None else version + 1


def files(run: Run, table: str, delta: DeltaTable) -> list[str]:
    """The table's files by name. DataError where one is missing or has another size than its commit says.

    Also where the newest has other columns than the table.
    """
    with readable(run, table):
        actions = pa.table(delta.get_add_actions(flatten=True)).select(["path", "size_bytes"]).sort_by("path")
        sizes = {row["path"]: row["size_bytes"] for row in actions.to_pylist()}
        there = place.sizes(run.tables / table)
        for file, size in sizes.items():
            if there.get(file) != size:
                raise damaged(run, table, f"{file} has {size} bytes, found {there.get(file, 'none')}")
        for file in list(sizes)[-1:]:  # the newest, which says what wrote last
            _check(run, table, run.tables / table / file)
    return [str(run.tables / table / file) for file in sizes]


def _check(run: Run, table: str, file: Path) -> None:
    """DataError for a file of a later version, or with columns of something else."""
    there = parquet.schema_of(str(file))
    if parquet.version_of(there) > schema.SCHEMA_VERSION:
        raise newer(run, parquet.version_of(there))
    wrong = parquet.differs(table, there)
    if wrong is not None:
        raise damaged(run, table, f"{file.name}: {wrong}")


def add(run: Run, table: str, number: int, stem: str, groups: Iterable[pa.Table]) -> None:
    """Write the file STEM-NUMBER.parquet and commit it, unless a file of that number is committed already.

    DataError where that one holds other rows, in a table that is large enough to be committed in groups.
    """
    folder = run.tables / table
    file = folder / f"{stem}-{number:06d}.parquet"
    delta = opened(run, table)
    if delta is not None and number < committed(delta):
        if table == "frames" and not parquet.holds(file, groups):
            raise DataError(
                f"{file} holds other episodes than those to be committed: the spool of iteration {number} "
                "was changed after the crash; restore it, or continue in a new run"
            )
        return
    statistics = _Statistics()
    folder.mkdir(exist_ok=True)
    parquet.write(file, schema.TABLES[table], map(statistics.seen, groups))
    _commit(run, table, delta, file, number, statistics)


def add_again(run: Run, table: str, number: int, file: Path) -> None:
    """Commit a file that is there, to a log that is being built anew. ArrowException or OSError where it is torn."""
    statistics = _Statistics()
    for group in parquet.groups(file, sorted(IDENTITIES.intersection(schema.TABLES[table].names))):
        statistics.seen(group)
    _commit(run, table, opened(run, table), file, number, statistics)


def _commit(run: Run, table: str, delta: DeltaTable | None, file: Path, number: int, statistics: _Statistics) -> None:
    """Make a file that is on disk part of its table, durably."""
    folder, definition = run.tables / table, Schema.from_arrow(schema.TABLES[table])
    with _writing(folder):
        delta = delta or DeltaTable.create(str(folder), definition)
        columns_came = _widened(delta, definition)
        delta.create_write_transaction(
            [AddAction(file.name, file.stat().st_size, {}, int(time.time() * 1000), True, statistics.to_json())],
            "append",
            definition,
            commit_properties=CommitProperties(
                custom_metadata={SHA256: durable.sha256(file)}, app_transactions=[Transaction(_APPLICATION, number)]
            ),
            post_commithook_properties=_NO_HOOKS,
        )
    log = folder / "_delta_log"
    entries = checkpoints.commits(log)
    for entry in entries[-2:]:  # the commit, and what may come with it: the table's creation, or new columns
        durable.sync(entry)
    for parent in (log, folder, run.tables):
        durable.sync(parent)
    if int(entries[-1].stem) % checkpoints.EVERY_N < (2 if columns_came else 1):
        with _writing(folder):
            checkpoints.write(folder)


def _widened(delta: DeltaTable, definition: Schema) -> bool:
    """Add the columns to a table that an earlier version did not know, in a commit of its own; whether there are any.

    Readers of Delta tables see what the log names. Rows of earlier files have null there.
    """
    known = {field.name for field in delta.schema().fields}
    later = [field for field in definition.fields if field.name not in known]
    if later:
        delta.alter.add_columns(later, post_commithook_properties=_NO_HOOKS)
    return bool(later)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """What the library says of an error of the system, such as a full disk, becomes that error, with its number."""
    try:
        yield
    except (DeltaError, OSError) as error:
        number = _SYSTEM_ERROR.search(str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(folder)) from error


@contextmanager
def readable(run: Run, table: str) -> Iterator[None]:
    """What libraries say of a table that they cannot read becomes a DataError; a StoreError where its store is away."""
    try:
        yield
    except (DeltaError, pa.ArrowException, OSError) as error:
        place.answers(run.path, error)
        raise damaged(run, table, _reason(error)) from error


def _reason(error: Exception) -> str:
    """A library's message in a line: Delta's may be a coloured chain of causes, others name places in their code."""
    lines = _COLOUR.sub("", str(error)).splitlines() or [type(error).__name__]
    causes = [line.strip(" ↳") for line in lines if "↳" in line]
    return ": ".join([lines[0].strip(), *causes])[:MESSAGE_LENGTH_N]


def damaged(run: Run, table: str, what: str) -> DataError:
    """The error for a table that is not whole."""
    return DataError(
        f"run {run.name} is not whole: table {table} in {run.tables / table} cannot be read: {what}; "
        f"restore the run from a copy: t6gps repair {run.name} --from COPY"
    )


def newer(run: Run, version: int) -> DataError:
    """The error for a run of a later version of the tables."""
    return DataError(
        f"run {run.name} has tables of version {version}, and this version reads up to {schema.SCHEMA_VERSION}; "
        "install the t6gps that wrote them"
    )


class _Statistics:
    """What Delta readers need to skip a file: its number of rows and the range of its identities."""

    def __init__(self) -> None:
        self._rows_n = 0
        self._least: dict[str, int] = {}
        self._most: dict[str, int] = {}

    def seen(self, group: pa.Table) -> pa.Table:
        """Count the rows of a row group, and hand it on."""
        self._rows_n += group.num_rows
        for name in IDENTITIES.intersection(group.column_names) if group.num_rows else ():
            ends = pc.min_max(group.column(name)).as_py()
            if ends["min"] is not None:
                self._least[name] = min(ends["min"], self._least.get(name, ends["min"]))
                self._most[name] = max(ends["max"], self._most.get(name, ends["max"]))
        return group

    def to_json(self) -> str:
        """As the Delta protocol has it."""
        return json.dumps(
            {"numRecords": self._rows_n, "minValues": self._least, "maxValues": self._most, "nullCount": {}},
            sort_keys=True,
        )
