"""The four Delta tables of a run: one commit per table and iteration, and reading them back as they were.

Tables cannot commit together. `episodes` goes last, and readers see only iterations that stand in it: a crash
between two commits leaves whole iterations, and committing the same iteration again completes it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from deltalake import DeltaTable, Schema
from deltalake.transaction import AddAction, CommitProperties, PostCommitHookProperties, Transaction

from t6gps.storage import durable, parquet, schema
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.records import Episode

EPISODES_PER_ROW_GROUP_N = 10
"""One episode is read without the rest of its iteration: 10 episodes are about 2.5 MB."""

_APPLICATION = "t6gps"
"""Application id of the Delta transactions; their version is the iteration."""


def commit_iteration(
    run: Run,
    iteration: int,
    episodes: Sequence[Episode],
    iteration_row: Mapping[str, object],
    class_rows: Sequence[Mapping[str, object]],
) -> None:
    """Commit everything that one iteration leaves behind; once this returns it survives a crash.

    An iteration that is committed already is left alone, one that was cut off is completed. Raises DataError
    for data that break their schema, RunError for an iteration out of turn; nothing is written in either
    case.
    """
    expected = committed_iterations(run)
    if iteration < expected:
        return
    if iteration > expected:
        raise RunError(f"{run.path}: iterations are committed in turn; next is {expected}, found {iteration}")
    if not episodes:
        raise DataError(f"iteration {iteration} has no episodes; sample at least one")
    pieces = sorted(episodes, key=_episode_id)
    if len({_episode_id(episode) for episode in pieces}) < len(pieces):
        raise DataError(f"iteration {iteration}: an episode was given twice; every episode_id must be unique")
    size_n = EPISODES_PER_ROW_GROUP_N
    groups = [pieces[start : start + size_n] for start in range(0, len(pieces), size_n)]
    summaries = _joined("episodes", [episode.summary for episode in pieces])
    rows = _from_rows("iterations", [iteration_row], iteration)
    classes = _from_rows("classes", class_rows, iteration)
    frames = [_joined("frames", [episode.frames for episode in group]) for group in groups]
    _commit(run, "frames", iteration, frames)
    _commit(run, "classes", iteration, [classes])
    _commit(run, "iterations", iteration, [rows])
    _commit(run, "episodes", iteration, [summaries])


def committed_iterations(run: Run) -> int:
    """How many iterations are committed: 0 .. n - 1."""
    location = str(run.tables / "episodes")
    return _committed(DeltaTable(location)) if DeltaTable.is_deltatable(location) else 0


def files(run: Run) -> tuple[int, dict[str, list[str]]]:
    """How many iterations are committed, and every table's Parquet files, which may hold one more."""
    iterations_n = committed_iterations(run)
    return iterations_n, {name: _files(run.tables / name) if iterations_n else [] for name in schema.TABLES}


def read(run: Run, table: str, columns: list[str] | None = None, filter: pc.Expression | None = None) -> pa.Table:
    """The committed rows of `table` in the order of their commit, bit for bit as committed, units included.

    columns   their names, in the wanted order; all when None
    filter    rows to keep, such as pyarrow.compute.field("iteration") == 3; all when None

    Raises DataError for an unknown table or column.
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
    found = _files(run.tables / table) if iterations_n else []
    return parquet.rows(table, found, iterations_n).to_table(names, filter=filter).cast(wanted)


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


def _files(folder: Path) -> list[str]:
    actions = pa.table(DeltaTable(str(folder)).get_add_actions(flatten=True))
    return [str(folder / name) for name in sorted(actions.column("path").to_pylist())]


def _episode_id(episode: Episode) -> int:
    return int(episode.summary.column("episode_id")[0].as_py())


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


def _commit(run: Run, table: str, iteration: int, groups: list[pa.Table]) -> None:
    """Add the file of one iteration to one table, unless it is there already."""
    folder = run.tables / table
    definition = Schema.from_arrow(schema.TABLES[table])
    if DeltaTable.is_deltatable(str(folder)):
        delta = DeltaTable(str(folder))
    else:
        delta = DeltaTable.create(str(folder), definition)
    file = folder / f"iteration-{iteration:06d}.parquet"
    if iteration < _committed(delta):
        if table == "frames" and not pq.read_table(file).equals(pa.concat_tables(groups)):
            raise DataError(
                f"{file} holds other episodes than those to be committed: the spool of iteration {iteration} "
                "was changed after the crash; restore it, or continue in a new run"
            )
        return
    parquet.write(file, groups)
    delta.create_write_transaction(
        [AddAction(file.name, file.stat().st_size, {}, int(time.time() * 1000), True, _statistics(groups))],
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


def _statistics(groups: list[pa.Table]) -> str:
    """What Delta readers need to skip the file: its number of rows and the range of its identities."""
    table = pa.concat_tables(groups)
    ranges = {
        name: pc.min_max(table.column(name)).as_py()
        for name in ("iteration", "episode_id")
        if name in table.column_names and table.num_rows
    }
    return json.dumps(
        {
            "numRecords": table.num_rows,
            "minValues": {name: ends["min"] for name, ends in ranges.items()},
            "maxValues": {name: ends["max"] for name, ends in ranges.items()},
            "nullCount": {},
        }
    )
