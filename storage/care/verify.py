"""Whether a run is as it was written: logs, files, pages, counts, references, digests. Nothing is written.

A run may be at work meanwhile. What its readers see is settled first: iterations by `episodes`, evaluations by
`evaluations`. Everything else is opened later, so it has these and perhaps more. A checkpoint or spooled episode
that is gone when a fault of it is found was replaced by the run.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from t6gps.storage import checkpoint, schema, spool
from t6gps.storage.care import delta_files, references
from t6gps.storage.care.delta_files import Found
from t6gps.storage.care.fault import Fault, Progress, within
from t6gps.storage.catalog import Run
from t6gps.storage.errors import CheckpointError, DataError
from t6gps.storage.objects import place

FIRST, LAST = ("episodes", "evaluations"), ("iterations",)
"""Tables that are committed last, and opened first; and the one that others refer to, which is opened last."""


def verify(run: Run, progress: Progress = lambda done, total: None) -> list[Fault]:
    """What is wrong with a run's tables, checkpoints and spool; a file is read a row group at a time."""
    states = checkpoint.kept(run.checkpoints)  # each is written after the tables
    names = (*FIRST, *(name for name in schema.TABLES if name not in FIRST + LAST), *LAST)
    there = run.tables.is_dir() or place.is_object(run.path)
    tables = {name: delta_files.opened(run, name) if there else Found(name) for name in names}
    iterations_n = tables["episodes"].committed_n
    waiting = spool.files(run.spool)
    work = [(found, entry) for found in tables.values() for entry in found.files]
    total = len(work) + len(states) + len(waiting)
    for done, (found, entry) in enumerate(work):
        progress(done, total)
        delta_files.examine(run, found, entry)
    complete = _complete(run, tables, iterations_n)
    faults = [] if there else [Fault("episodes", run.tables.name, "it is no folder", repairable=True)]
    faults += (fault for found in tables.values() for fault in found.faults)
    faults += references.faults(tables, iterations_n, complete)
    progress(len(work), total)
    faults += _checkpoints(run, states, iterations_n)
    progress(len(work) + len(states), total)
    faults += _spooled(run, waiting)
    progress(total, total)
    return faults


def owns_origin(run: Run) -> bool:
    """True for a run whose version of t6gps kept what made it: its first episodes say so."""
    begun = delta_files.begun_with(delta_files.opened(run, "episodes"))
    return begun is not None and begun >= max(schema.YOUNGER.values())


def _complete(run: Run, tables: dict[str, Found], iterations_n: int) -> bool:
    """See that each table has the iterations and evaluations that its readers see; whether it began with all tables."""
    begun = delta_files.begun_with(tables["episodes"])
    after_n = delta_files.opened(run, "episodes").committed_n
    evaluated = {entry.path.name for entry in tables["evaluations"].files}
    for name in schema.OF_ITERATIONS:
        found = tables[name]
        younger = name in schema.YOUNGER and (begun is None or begun < schema.YOUNGER[name])
        has_n = found.committed_n if len(found.files) >= found.committed_n else len(found.files)
        if not found.faults and has_n < iterations_n and not younger:
            _lacking(found, has_n, f"its log has {has_n} of {iterations_n} iterations")
        elif found.committed_n > after_n + 1 and not tables["episodes"].faults:
            _lacking(
                tables["episodes"], after_n, f"its log has {after_n} of {found.committed_n - 1} iterations or more"
            )
    for name in schema.OF_EVALUATIONS:
        found = tables[name]
        missing = sorted(evaluated - {entry.path.name for entry in found.files})
        if not found.faults and missing:
            number = delta_files.number_of(missing[0])
            _lacking(found, number, f"its log has no file {missing[0]}")
    return begun is not None and begun >= max(schema.YOUNGER.values())


def _lacking(found: Found, number: int | None, what: str) -> None:
    found.faults.append(Fault(found.table, f"tables/{found.table}/_delta_log", what, number, repairable=True))


def _checkpoints(run: Run, states: dict[int, Path], iterations_n: int) -> Iterator[Fault]:
    """Checkpoints that are not whole, and iterations that the tables lack although a learner has finished them."""
    finished_n = 0
    for iteration, path in sorted(states.items()):
        try:
            manifest = checkpoint.load(path)[1]
        except CheckpointError as error:
            # In an object store it appears file by file, DONE last.
            if (path / "DONE").exists() if place.is_object(path) else path.exists():
                yield Fault("checkpoints", within(run, path), str(error), repairable=True)
        else:
            # Baselines keep a state of their policy, and have no iterations.
            finished_n = iteration if "ledger" in manifest or iterations_n else 0
    if finished_n > iterations_n:
        what = f"the checkpoint is of iteration {finished_n}, its log has {iterations_n}"
        yield Fault("episodes", "tables/episodes/_delta_log", what, iterations_n, repairable=True)


def _spooled(run: Run, waiting: list[Path]) -> Iterator[Fault]:
    for path in waiting:
        try:
            spool.checked(spool.read(path), spool.iteration_of(path))
        except (pa.ArrowException, OSError, DataError) as error:
            place.answers(path, error)
            if path.exists():
                what = (str(error).splitlines() or [type(error).__name__])[0]
                yield Fault("spool", within(run, path), what, repairable=True)
