"""Whether a run is as it was written, with what only the service can read: settings, ground, evaluations."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

from t6gps.service import config as configuration
from t6gps.service.training import evaluation, origin, study_origin
from t6gps.service.training.evaluation import Estimate, Evaluation
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.care import verify as care
from t6gps.storage.care.fault import Fault, Progress, within
from t6gps.storage.care.mending import DAMAGED
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, RunError, T6GpsError
from t6gps.storage.objects import place


def verify(run: Run, progress: Progress = lambda done, total: None) -> list[Fault]:
    """Everything that is wrong with a run, which may be at work meanwhile. Nothing is written.

    What is wrong with its parts, and parts that have gone. StoreError where it lies in an object store that does not
    answer; a copy there may be behind with checkpoints and evaluations, and has no fault so.
    """
    faults = unsound(run, progress)
    return faults if place.is_object(run.path) else [*faults, *_gone(run)]


def unsound(run: Run, progress: Progress = lambda done, total: None) -> list[Fault]:
    """What is wrong with the parts that a run has, though it may be behind with some. StoreError as `verify`."""
    # The file of an evaluation is written after the row that it is held against.
    own = [*_settings(run), *_study(run), *_evaluations(run)]
    faults = own + care.verify(run, progress)
    if faults:
        place.answers(run.path)  # a store that has gone away is no fault of the run
    return faults


def _settings(run: Run) -> Iterator[Fault]:
    """Faults of what a run was created with."""
    try:
        config = configuration.kept(run)
    except T6GpsError as error:
        yield Fault("config", "config.json", str(error))
        return
    try:
        made = origin.kept(run)
    except T6GpsError as error:
        yield Fault("origin", origin.FILE, str(error))
        return
    if made is None and care.owns_origin(run):
        yield Fault("origin", origin.FILE, "it is missing")
    if made is not None and made.ground is not None:
        try:
            origin.at_work(config, run)
        except T6GpsError as error:
            yield Fault("ground", made.ground.file, str(error))


def _study(run: Run) -> Iterator[Fault]:
    """Faults of a run's place in a study."""
    try:
        if (run.path / study_origin.FILE).exists():
            study_origin.origin(run)
    except RunError as error:
        yield Fault("study", study_origin.FILE, str(error))


def _gone(run: Run) -> Iterator[Fault]:
    """Parts that whoever ended the training has left, and that neither a repair nor a crash explains.

    A crash leaves the last iteration without its checkpoint, which comes after the tables.
    """
    if _is_held(run):
        return
    try:
        iterations_n, evaluated = tables.committed_iterations(run), _rows(run, None)
    except DataError:  # said of the tables themselves
        return
    files = (evaluation.FILE, f"{DAMAGED}/{evaluation.FILE}")
    if evaluated and not any((run.path / file).exists() for file in files):
        what = "it is missing, and evaluations has its row: resume the run, which writes it again"
        yield Fault("evaluation", evaluation.FILE, what)
    kept = {*checkpoint.kept(run.checkpoints), *checkpoint.kept(run.path / DAMAGED / run.checkpoints.name)}
    needed = max([iterations_n - 1, *(row["policy_version"] for row in evaluated)])
    if needed > max(kept, default=0):
        other = f"the newest is of iteration {max(kept)}" if kept else "there is no other"
        what = f"it is missing, and {other}: resume the run, which makes it again"
        yield Fault("checkpoints", within(run, checkpoint.place_of(run.checkpoints, needed)), what)


def _is_held(run: Run) -> bool:
    """True where another process trains the run, and where that cannot be known."""
    try:
        return catalog.process_of(run) not in (None, os.getpid())  # this one repairs it
    except RunError:
        return True


def _evaluations(run: Run) -> Iterator[Fault]:
    """Faults of the files of evaluations, the first of which is also a row of `evaluations`."""
    conditions = sorted(path.stem for path in (run.path / "conditions").glob("*.json"))
    for condition in (None, *conditions):
        file = evaluation.FILE if condition is None else f"conditions/{condition}.json"
        try:
            result = evaluation.kept(run, condition)
        except T6GpsError as error:
            yield Fault("evaluation", file, str(error), repairable=True)
            continue
        if result is None:
            continue
        known = _in_table(run, condition)
        if known == [] and care.owns_origin(run):
            yield Fault("evaluations", "tables/evaluations/_delta_log", f"it lacks what {file} has", 0, repairable=True)
        elif known not in ([], None, [result]):
            yield Fault("evaluation", file, "it differs from the row in evaluations", repairable=True)


def _in_table(run: Run, condition: str | None) -> list[Evaluation] | None:
    """The newest such evaluation that the table has, if it has one; None where it cannot be read."""
    try:
        newest = _rows(run, condition)[-1:]
    except DataError:  # said of the table itself
        return None
    return [
        Evaluation(
            episodes=row["episodes"],
            seed=row["seed"],
            **{name: Estimate(row[name], row[f"{name}_standard_error"]) for name in evaluation.EVALUATED},
        )
        for row in newest
    ]


def _rows(run: Run, condition: str | None) -> list[dict[str, Any]]:
    """The rows of such evaluations by the policies' versions. DataError where the table cannot be read."""
    purpose = "training" if condition is None else "condition"
    rows = tables.read(run, "evaluations").to_pylist()
    chosen = [row for row in rows if (row["purpose"], row["condition"]) == (purpose, condition)]
    return sorted(chosen, key=lambda row: row["policy_version"])
