"""What the iterations of a run leave: one file per table and iteration, committed in turn.

Tables cannot commit together. `episodes` goes last, and readers see only iterations that stand in it: a crash
between two commits leaves whole iterations, and committing the same iteration again completes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import pyarrow as pa

from t6gps.storage import checkpoint, fields, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, parquet, policies
from t6gps.storage.delta.parquet import Files
from t6gps.storage.errors import CheckpointError, DataError, RunError
from t6gps.storage.objects import place
from t6gps.storage.records import Episode, Learned

STEM = "iteration"
EPISODES_PER_ROW_GROUP_N = 10
"""One episode is read without the rest of its iteration: 10 episodes are about 2.5 MB."""


def commit(run: Run, iteration: int, episodes: Iterable[Episode], learned: Learned) -> None:
    """Commit everything that one iteration leaves behind; once this returns it survives a crash.

    episodes   in ascending order of their numbers; no more than a row group of them is held at a time

    An iteration that is committed already is left alone, one that was cut off is completed. Raises DataError
    for data that break their schema, RunError for an iteration out of turn; nothing is written in either
    case.
    """
    expected = committed(run)
    if iteration < expected:
        return
    if iteration > expected:
        raise RunError(f"{run.path}: iterations are committed in turn; next is {expected}, found {iteration}")
    summaries: list[pa.Table] = []
    one_group = {
        "classes": _from_rows("classes", learned.classes, iteration),
        "models": fields.check(learned.models, schema.MODELS, f"models of iteration {iteration}"),
        "policies": _from_rows("policies", [policies.row(policy) for policy in learned.policies], iteration),
        "iterations": _from_rows("iterations", [learned.iteration], iteration),
    }
    log.add(run, "frames", iteration, STEM, row_groups(episodes, f"iteration {iteration}", summaries))
    for table, rows in one_group.items():
        log.add(run, table, iteration, STEM, [rows])
    log.add(run, "episodes", iteration, STEM, [pa.concat_tables(summaries).cast(schema.EPISODES)])


def row_groups(episodes: Iterable[Episode], where: str, summaries: list[pa.Table]) -> Iterator[pa.Table]:
    """Frames of a few episodes at a time; their summaries are added to `summaries`. DataError for others than asked."""
    newest, group = -1, list[pa.Table]()
    for episode in episodes:
        if episode.episode_id <= newest:
            raise DataError(
                f"{where}: episodes must come in ascending order, each once; found {episode.episode_id} after {newest}"
            )
        newest = episode.episode_id
        summaries.append(episode.summary.take([0]))  # a copy: the episode's memory is not held
        group.append(episode.frames)
        if len(group) == EPISODES_PER_ROW_GROUP_N:
            yield pa.concat_tables(group).cast(schema.FRAMES)
            group.clear()
    if group:
        yield pa.concat_tables(group).cast(schema.FRAMES)
    if not summaries:
        raise DataError(f"{where} has no episodes; sample at least one")


def committed(run: Run) -> int:
    """How many iterations are committed: 0 .. n - 1. DataError where the table that says so is damaged or missing."""
    with log.readable(run, "episodes"):
        there = place.is_object(run.path) or run.tables.is_dir()  # in an object store a folder comes with its files
    if not there:
        raise log.damaged(run, "episodes", f"{run.tables} is no folder")
    episodes = log.opened(run, "episodes")
    if episodes is not None:
        return log.committed(episodes)
    others = {name: log.committed(log.opened(run, name)) for name in schema.OF_ITERATIONS}
    name = max(others, key=others.__getitem__)
    finished_n = finished(run)
    if others[name] <= 1 and not finished_n:
        return 0
    episodes = log.opened(run, "episodes")  # once more: iterations may have been committed meanwhile
    if episodes is None:
        of = f"{name} has {others[name]} iterations" if others[name] > 1 else f"a checkpoint has {finished_n}"
        raise log.damaged(run, "episodes", f"it is missing, and {of}")
    return log.committed(episodes)


def finished(run: Run) -> int:
    """The iterations that the newest sound checkpoint of a learner follows; 0 without one.

    The states of baselines are not of iterations, and lack a ledger.
    """
    for iteration, path in sorted(checkpoint.kept(run.checkpoints).items(), reverse=True):
        try:
            return iteration if "ledger" in checkpoint.manifest(path) else 0
        except CheckpointError:  # it is torn, of which verifying tells, or has gone meanwhile
            continue
    return 0


def files(run: Run, table: str, iterations_n: int) -> Files:
    """The files of a table of `iterations_n` or more iterations, one each. DataError where one is not whole."""
    if not iterations_n:
        return Files([])
    delta = log.opened(run, table)
    if delta is None:
        if _younger(run, table):
            return Files([])
        raise log.damaged(run, table, "it is missing")
    found, committed_n = log.files(run, table, delta), log.committed(delta)
    if len(found) < max(iterations_n, committed_n) and not _younger(run, table):
        raise log.damaged(run, table, f"its log has {len(found)} of {max(iterations_n, committed_n)} iterations")
    if committed_n > iterations_n + 1 and committed(run) == iterations_n:
        raise log.damaged(run, "episodes", f"its log has {iterations_n} of {committed_n - 1} iterations or more")
    return Files(found, iterations_n if committed_n > iterations_n else None)


def _younger(run: Run, table: str) -> bool:
    """True for a table that the version of t6gps that began the run did not know."""
    episodes = log.opened(run, "episodes")
    if table not in schema.YOUNGER or episodes is None:
        return False
    return parquet.version(log.files(run, "episodes", episodes)[0]) < schema.YOUNGER[table]


def _from_rows(table: str, rows: Sequence[Mapping[str, object]], iteration: int) -> pa.Table:
    where, names = f"{table} of iteration {iteration}", schema.TABLES[table].names
    for row in rows:
        if set(row) != set(names):
            raise DataError(f"{where}: a row must have exactly {names}, found {list(row)}")
        if row["iteration"] not in (iteration, None):
            raise DataError(f"{where}: a row belongs to iteration {row['iteration']}")
    return from_rows(table, rows, where)


def from_rows(table: str, rows: Sequence[Mapping[str, object]], where: str) -> pa.Table:
    """Rows of a table. DataError naming `where` for one that breaks its schema."""
    try:
        found = pa.Table.from_pylist(list(rows), schema.TABLES[table])
    except (pa.ArrowException, TypeError, OverflowError) as error:
        raise DataError(f"{where}: {error}") from error
    return fields.check(found, schema.TABLES[table], where)
