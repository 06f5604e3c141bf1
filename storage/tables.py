"""The tables of a run, read back as they were committed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from t6gps.storage import schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import evaluations, iterations, log, parquet, policies, row_groups
from t6gps.storage.delta.parquet import Files
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode, PolicySnapshot

KNOWN_RUNS_N, KNOWN_SUMMARIES_N = 1024, 16
"""Runs whose files are remembered until they change, and tables of episodes."""


def committed_iterations(run: Run) -> int:
    """How many iterations are committed: 0 .. n - 1. DataError where the table that says so is damaged or missing."""
    return iterations.committed(run)


def files(run: Run, names: Collection[str] = schema.TABLES.keys()) -> dict[str, Files]:
    """The Parquet files of tables, by default of all. DataError where one of them is missing or damaged."""
    state = log.state(run)
    # A run whose tables are lost looks as it did before the first iteration.
    return _files(run, frozenset(names)) if not any(state) else dict(_known_files(run, frozenset(names), state))


@lru_cache(KNOWN_RUNS_N)
def _known_files(run: Run, names: frozenset[str], state: object) -> dict[str, Files]:
    return _files(run, names)


def _files(run: Run, names: frozenset[str]) -> dict[str, Files]:
    iterations_n, evaluated = iterations.committed(run), log.opened(run, "evaluations")
    return {
        **{name: iterations.files(run, name, iterations_n) for name in schema.OF_ITERATIONS if name in names},
        **{name: evaluations.files(run, name, evaluated) for name in schema.OF_EVALUATIONS if name in names},
    }


def read(run: Run, table: str, columns: list[str] | None = None, filter: pc.Expression | None = None) -> pa.Table:
    """The committed rows of `table` in the order of their commit, bit for bit as committed, units included.

    columns   their names, in the wanted order; all when None
    filter    rows to keep, such as pyarrow.compute.field("iteration") == 3; all when None

    Raises DataError for an unknown table or column, and where the table is damaged.
    """
    if table not in schema.TABLES:
        raise DataError(f"there is no table {table!r}; tables: {', '.join(schema.TABLES)}")
    wanted = columns_of(table, columns)
    if table in schema.OF_ITERATIONS:
        found = iterations.files(run, table, iterations.committed(run))
    else:
        found = evaluations.files(run, table, log.opened(run, "evaluations"))
    with log.readable(run, table):
        return parquet.rows(table, found).to_table(wanted.names, filter=filter).cast(wanted)


def columns_of(table: str, names: Sequence[str] | None) -> pa.Schema:
    """Columns of a table, all by default. DataError for one that it has not."""
    whole = schema.TABLES[table]
    for name in names or ():
        if name not in whole.names:
            raise DataError(f"table {table} has no column {name!r}; columns: {', '.join(whole.names)}")
    return whole if names is None else pa.schema([whole.field(name) for name in names], whole.metadata)


def policy(run: Run, version: int) -> PolicySnapshot:
    """The policy of a version that the table `policies` has. DataError for one that fails its SHA-256."""
    return policies.policy(read(run, "policies", filter=pc.field("version") == version).to_pylist()[0])


def episode(
    run: Run, episode_id: int, evaluation_id: int | None = None, columns: Sequence[str] | None = None
) -> Episode:
    """One episode of training, or of an evaluation: T + 1 frames and its row. DataError naming the episodes there are.

    columns   of its frames, which are those of the table, `frames` or `evaluation_frames`; all by default
    """
    prefix, chosen = "", {"episode_id": episode_id}
    if evaluation_id is not None:
        prefix, chosen = "evaluation_", {"evaluation_id": evaluation_id, **chosen}
    summary = _where(_summaries(run, f"{prefix}episodes", log.state(run)), chosen)
    if not summary.num_rows:
        raise _unknown(run, episode_id, evaluation_id)
    table = f"{prefix}frames"
    wanted = columns_of(table, columns)
    with log.readable(run, table):
        found = [
            _where(row_groups.read(table, group, list(dict.fromkeys([*wanted.names, *chosen]))), chosen)
            for group in row_groups.groups(files(run, [table])[table])
            if group.first <= episode_id <= group.last
        ]
    if not found:
        raise log.damaged(run, table, f"it has no episode {episode_id}, which {prefix}episodes has")
    return Episode(pa.concat_tables(found).select(wanted.names).cast(wanted), summary)


def _where(rows: pa.Table, values: Mapping[str, int]) -> pa.Table:
    """The rows with these values; a filter by an expression would cost five times as much."""
    chosen = [rows.column(name).to_numpy() == value for name, value in values.items()]
    return rows.filter(pa.array(np.logical_and.reduce(chosen)))


@lru_cache(KNOWN_SUMMARIES_N)
def _summaries(run: Run, table: str, state: object) -> pa.Table:
    return read(run, table)


def _unknown(run: Run, episode_id: int, evaluation_id: int | None) -> DataError:
    prefix, of = "", pc.scalar(True)
    where = f"run {run.name}"
    if evaluation_id is not None:
        prefix, of = "evaluation_", pc.field("evaluation_id") == evaluation_id
        where = f"evaluation {evaluation_id} of run {run.name}"
    known = read(run, f"{prefix}episodes", ["episode_id"], of).column("episode_id")
    if not len(known):
        why = "no iteration is committed yet" if evaluation_id is None else "there is no such evaluation"
        return DataError(f"{where} has no episode {episode_id}: {why}")
    ends = pc.min_max(known).as_py()
    there = f"{len(known)} episodes lie in {ends['min']} .. {ends['max']}"
    return DataError(f"{where} has no episode {episode_id}; its {there}")


def episodes_of(run: Run, iteration: int, columns: Sequence[str] | None = None) -> list[Episode]:
    """The episodes of an iteration in ascending order of their ids, with all columns of `frames` or some."""
    where, order = pc.field("iteration") == iteration, ["episode_id", "step"]
    wanted = None if columns is None else list(dict.fromkeys([*columns, *order]))
    frames = read(run, "frames", wanted, where).sort_by([(name, "ascending") for name in order])
    summary = read(run, "episodes", filter=where).sort_by("episode_id")
    lengths = summary.column("steps").to_numpy() + 1
    first = np.cumsum(lengths) - lengths
    return [
        Episode(frames.slice(start, length), summary.slice(number, 1))
        for number, (start, length) in enumerate(zip(first.tolist(), lengths.tolist(), strict=True))
    ]
