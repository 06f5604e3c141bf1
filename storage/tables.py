"""The four Delta tables of a run: one commit per table and iteration, and reading them back as they were.

Tables cannot commit together. `episodes` goes last, and readers see only iterations that stand in it: a crash
between two commits leaves whole iterations, and committing the same iteration again completes it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable, Schema
from deltalake.exceptions import DeltaError
from deltalake.transaction import AddAction, CommitProperties, PostCommitHookProperties, Transaction

from t6gps.storage import durable, parquet, schema
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.records import Episode

EPISODES_PER_ROW_GROUP_N = 10
"""One episode is read without the rest of its iteration: 10 episodes are about 2.5 MB."""

MESSAGE_LENGTH_N = 300
"""Characters of a library's message that are repeated; it may add where in its own code it stopped."""

_APPLICATION = "t6gps"
"""Application id of the Delta transactions; their version is the iteration."""


def commit_iteration(
    run: Run,
    iteration: int,
    episodes: Iterable[Episode],
    iteration_row: Mapping[str, object],
    class_rows: Sequence[Mapping[str, object]],
) -> None:
    """Commit everything that one iteration leaves behind; once this returns it survives a crash.

    episodes   in ascending order of their numbers; no more than a row group of them is held at a time

    An iteration that is committed already is left alone, one that was cut off is completed. Raises DataError
    for data that break their schema, RunError for an iteration out of turn; nothing is written in either
    case.
    """
    expected = committed_iterations(run)
    if iteration < expected:
        return
    if iteration > expected:
        raise RunError(f"{run.path}: iterations are committed in turn; next is {expected}, found {iteration}")
    rows = _from_rows("iterations", [iteration_row], iteration)
    classes = _from_rows("classes", class_rows, iteration)
    summaries: list[pa.Table] = []
    _commit(run, "frames", iteration, _row_groups(episodes, iteration, summaries))
    _commit(run, "classes", iteration, [classes])
    _commit(run, "iterations", iteration, [rows])
    _commit(run, "episodes", iteration, [_joined("episodes", summaries)])


def _row_groups(episodes: Iterable[Episode], iteration: int, summaries: list[pa.Table]) -> Iterator[pa.Table]:
    """Frames of a few episodes at a time; their summaries are added to `summaries`."""
    newest, group = -1, list[pa.Table]()
    for episode in episodes:
        if episode.episode_id <= newest:
            raise DataError(
                f"iteration {iteration}: episodes must come in ascending order, each once; "
                f"found {episode.episode_id} after {newest}"
            )
        newest = episode.episode_id
        summaries.append(episode.summary.take([0]))  # a copy: the episode's memory is not held
        group.append(episode.frames)
        if len(group) == EPISODES_PER_ROW_GROUP_N:
            yield _joined("frames", group)
            group.clear()
    if group:
        yield _joined("frames", group)
    if not summaries:
        raise DataError(f"iteration {iteration} has no episodes; sample at least one")


def committed_iterations(run: Run) -> int:
    """How many iterations are committed: 0 .. n - 1. DataError where the table that says so is damaged or missing."""
    episodes = _delta(run, "episodes")
    if episodes is not None:
        return _committed(episodes)
    for name in schema.TABLES:
        other = _delta(run, name)
        if other is not None and _committed(other) > 1:
            raise _damaged(run, "episodes", f"it is missing, and {name} has {_committed(other)} iterations")
    return 0


def files(run: Run) -> tuple[int, dict[str, list[str]]]:
    """How many iterations are committed, and every table's Parquet files, which may hold more.

    DataError where a table or a file is missing or damaged.
    """
    iterations_n = committed_iterations(run)
    return iterations_n, {name: _files(run, name, iterations_n) for name in schema.TABLES}


def read(run: Run, table: str, columns: list[str] | None = None, filter: pc.Expression | None = None) -> pa.Table:
    """The committed rows of `table` in the order of their commit, bit for bit as committed, units included.

    columns   their names, in the wanted order; all when None
    filter    rows to keep, such as pyarrow.compute.field("iteration") == 3; all when None

    Raises DataError for an unknown table or column, and where the table is damaged.
    """
    if table not in schema.TABLES:
        raise DataError(f"there is no table {table!r}; tables: {', '.join(schema.TABLES)}")
    whole = schema.TABLES[table]
    names = whole.names if columns is None else columns
    unknown = [name for name in names if name not in whole.names]
    if unknown:
        raise DataError(f"table {table} has no column {unknown[0]!r}; columns: {', '.join(whole.names)}")
    wanted = pa.schema([whole.field(name) for name in names], whole.metadata)
    iterations_n = committed_iterations(run)
    paths = _files(run, table, iterations_n)
    with _readable(run, table):
        return parquet.rows(table, paths, iterations_n).to_table(names, filter=filter).cast(wanted)


def episode_frames(run: Run, episode_id: int) -> pa.Table:
    """The frames of one episode, T + 1 rows. Raises DataError naming the episodes that exist."""
    frames = read(run, "frames", filter=pc.field("episode_id") == episode_id)
    if frames.num_rows:
        return frames
    known = read(run, "episodes", ["episode_id"]).column("episode_id")
    if not len(known):
        raise DataError(f"run {run.name} has no episode {episode_id}: no iteration is committed yet")
    ends = pc.min_max(known).as_py()
    raise DataError(
        f"run {run.name} has no episode {episode_id}; its {len(known)} episodes lie in {ends['min']} .. {ends['max']}"
    )


def frames_of(run: Run, iteration: int, columns: Sequence[str]) -> dict[int, pa.Table]:
    """Columns of the frames of an iteration by episode, in ascending order."""
    where = pc.field("iteration") == iteration
    table = read(run, "frames", [*columns, "episode_id", "step"], where).sort_by(
        [("episode_id", "ascending"), ("step", "ascending")]
    )
    numbers, first = np.unique(table.column("episode_id").to_numpy(), return_index=True)
    lengths = np.diff(first, append=table.num_rows)
    return {
        int(number): table.slice(start, length).select(columns)
        for number, start, length in zip(numbers, first.tolist(), lengths.tolist(), strict=True)
    }


def _files(run: Run, table: str, iterations_n: int) -> list[str]:
    """The files of a table of `iterations_n` or more iterations, one each. DataError where one is not whole."""
    if not iterations_n:
        return []
    delta = _delta(run, table)
    if delta is None:
        raise _damaged(run, table, "it is missing")
    with _readable(run, table):
        actions = pa.table(delta.get_add_actions(flatten=True)).select(["path", "size_bytes"]).sort_by("path")
        sizes = {run.tables / table / row["path"]: row["size_bytes"] for row in actions.to_pylist()}
        for file, size in sizes.items():
            if not file.is_file() or file.stat().st_size != size:
                found = f"{file.stat().st_size}" if file.is_file() else "none"
                raise _damaged(run, table, f"{file.name} has {size} bytes, found {found}")
    committed_n = _committed(delta)
    if len(sizes) < max(iterations_n, committed_n):
        raise _damaged(run, table, f"its log has {len(sizes)} of {max(iterations_n, committed_n)} iterations")
    if committed_n > iterations_n + 1 and committed_iterations(run) == iterations_n:
        raise _damaged(run, "episodes", f"its log has {iterations_n} of {committed_n - 1} iterations or more")
    return [str(file) for file in sizes]


def _delta(run: Run, table: str) -> DeltaTable | None:
    """A table by its log, None before the first commit. DataError where the log is damaged."""
    location = str(run.tables / table)
    with _readable(run, table):
        return DeltaTable(location) if DeltaTable.is_deltatable(location) else None


@contextmanager
def _readable(run: Run, table: str) -> Iterator[None]:
    """What libraries say of a table that they cannot read becomes a DataError."""
    try:
        yield
    except (DeltaError, pa.ArrowException, OSError) as error:
        lines = str(error).splitlines() or [type(error).__name__]
        raise _damaged(run, table, lines[0][:MESSAGE_LENGTH_N]) from error


def _damaged(run: Run, table: str, what: str) -> DataError:
    return DataError(
        f"run {run.name} is not whole: table {table} in {run.tables / table} cannot be read: {what}; "
        "restore the run from a copy"
    )


def _joined(table: str, parts: list[pa.Table]) -> pa.Table:
    return pa.concat_tables([part.cast(schema.TABLES[table]) for part in parts])


def _from_rows(table: str, rows: Sequence[Mapping[str, object]], iteration: int) -> pa.Table:
    where, names = f"{table} of iteration {iteration}", schema.TABLES[table].names
    for row in rows:
        if set(row) != set(names):
            raise DataError(f"{where}: a row must have exactly {names}, found {list(row)}")
        if row["iteration"] != iteration:
            raise DataError(f"{where}: a row belongs to iteration {row['iteration']}")
    try:
        table_of_rows = pa.Table.from_pylist(list(rows), schema.TABLES[table])
    except (pa.ArrowException, TypeError, OverflowError) as error:
        raise DataError(f"{where}: {error}") from error
    return schema.check(table_of_rows, schema.TABLES[table], where)


def _committed(delta: DeltaTable) -> int:
    version = delta.transaction_version(_APPLICATION)
    return 0 if version is None else version + 1


def _commit(run: Run, table: str, iteration: int, groups: Iterable[pa.Table]) -> None:
    """Add the file of one iteration to one table, unless it is there already."""
    folder = run.tables / table
    definition = Schema.from_arrow(schema.TABLES[table])
    file = folder / f"iteration-{iteration:06d}.parquet"
    delta = _delta(run, table)
    if delta and iteration < _committed(delta):
        if table == "frames" and not parquet.holds(file, groups):
            raise DataError(
                f"{file} holds other episodes than those to be committed: the spool of iteration {iteration} "
                "was changed after the crash; restore it, or continue in a new run"
            )
        return
    statistics = _Statistics()
    folder.mkdir(exist_ok=True)
    parquet.write(file, schema.TABLES[table], map(statistics.seen, groups))
    delta = delta or DeltaTable.create(str(folder), definition)
    delta.create_write_transaction(
        [AddAction(file.name, file.stat().st_size, {}, int(time.time() * 1000), True, statistics.to_json())],
        "append",
        definition,
        commit_properties=CommitProperties(app_transactions=[Transaction(_APPLICATION, iteration)]),
        # Checkpoints of the log are not forced to disk by the library; a run's log is short enough without.
        post_commithook_properties=PostCommitHookProperties(create_checkpoint=False, cleanup_expired_logs=False),
    )
    log = folder / "_delta_log"
    for entry in sorted(log.glob("*.json"))[-2:]:  # the commit, and the table's creation before the first
        durable.sync(entry)
    for parent in (log, folder, run.tables):
        durable.sync(parent)


class _Statistics:
    """What Delta readers need to skip a file: its number of rows and the range of its identities."""

    def __init__(self) -> None:
        self._rows_n = 0
        self._least: dict[str, int] = {}
        self._most: dict[str, int] = {}

    def seen(self, group: pa.Table) -> pa.Table:
        """Count the rows of a row group, and hand it on."""
        self._rows_n += group.num_rows
        for name in {"iteration", "episode_id"}.intersection(group.column_names) if group.num_rows else ():
            ends = pc.min_max(group.column(name)).as_py()
            self._least[name] = min(ends["min"], self._least.get(name, ends["min"]))
            self._most[name] = max(ends["max"], self._most.get(name, ends["max"]))
        return group

    def to_json(self) -> str:
        """As the Delta protocol has it."""
        return json.dumps(
            {"numRecords": self._rows_n, "minValues": self._least, "maxValues": self._most, "nullCount": {}},
            sort_keys=True,
        )
