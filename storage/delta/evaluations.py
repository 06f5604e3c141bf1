"""Noise-free episodes of policies: one file per table and evaluation, numbered in turn.

`evaluations` goes last, and readers see only what stands in it. A number that a crash has left half committed is not
used again.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import pyarrow as pa
from deltalake import DeltaTable

from t6gps.storage import schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.delta.iterations import from_rows, row_groups
from t6gps.storage.delta.parquet import Files
from t6gps.storage.records import Episode

STEM = "evaluation"


def commit(run: Run, row: Mapping[str, object], episodes: Iterable[Episode]) -> int:
    """Commit an evaluation and its episodes, in ascending order of their numbers; its number.

    row   of `evaluations`, without its number

    Once this returns it survives a crash. Raises DataError for data that break their schema.
    """
    with _alone(run):
        number = max(log.committed(log.opened(run, table)) for table in schema.OF_EVALUATIONS)
        where = f"evaluation {number}"
        described = from_rows("evaluations", [{"evaluation_id": number, **row}], where)
        summaries: list[pa.Table] = []
        groups = (_of("evaluation_frames", number, group) for group in row_groups(episodes, where, summaries))
        log.add(run, "evaluation_frames", number, STEM, groups)
        log.add(
            run, "evaluation_episodes", number, STEM, [_of("evaluation_episodes", number, pa.concat_tables(summaries))]
        )
        log.add(run, "evaluations", number, STEM, [described])
    return number


def files(run: Run, table: str, evaluations: DeltaTable | None) -> Files:
    """The files of a table, one for each evaluation that stands in `evaluations`. DataError where one is not whole."""
    if evaluations is None:
        return Files([])
    known = [file.rsplit("/", 1)[1] for file in log.files(run, "evaluations", evaluations)]
    delta = log.opened(run, table)
    found = {} if delta is None else {file.rsplit("/", 1)[1]: file for file in log.files(run, table, delta)}
    missing = [name for name in known if name not in found]
    if missing:
        raise log.damaged(run, table, f"it has no file {missing[0]}")
    return Files([found[name] for name in known])


def _of(table: str, number: int, rows: pa.Table) -> pa.Table:
    """Rows of an evaluation's episodes."""
    numbers = pa.array([number] * rows.num_rows, pa.int32())
    columns = {"evaluation_id": numbers, **{name: rows.column(name) for name in rows.column_names}}
    definition = schema.TABLES[table]
    return pa.table([columns[name] for name in definition.names], schema=definition)


@contextmanager
def _alone(run: Run) -> Iterator[None]:
    """Let no other process number an evaluation meanwhile."""
    with (run.path / ".evaluations").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
