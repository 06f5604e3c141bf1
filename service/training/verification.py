"""Whether a run is as it was written, with what only the service can read: settings, ground, evaluations."""

from __future__ import annotations

from collections.abc import Iterator

from t6gps.service import config as configuration
from t6gps.service.training import evaluation, origin
from t6gps.service.training.evaluation import Estimate, Evaluation
from t6gps.storage import tables
from t6gps.storage.care import verify as care
from t6gps.storage.care.fault import Fault, Progress
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, T6GpsError
from t6gps.storage.objects import place


def verify(run: Run, progress: Progress = lambda done, total: None) -> list[Fault]:
    """Everything that is wrong with a run, which may be at work meanwhile. Nothing is written.

    StoreError where it lies in an object store that does not answer.
    """
    own = [*_settings(run), *_evaluations(run)]  # the file is written after the row that it is held against
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


def _evaluations(run: Run) -> Iterator[Fault]:
    """Faults of the files of evaluations, the first of which is also a row of `evaluations`."""
    conditions = sorted(path.stem for path in (run.path / "conditions").glob("*.json"))
    for condition in (None, *conditions):
        place = "evaluation.json" if condition is None else f"conditions/{condition}.json"
        try:
            result = evaluation.kept(run, condition)
        except T6GpsError as error:
            yield Fault("evaluation", place, str(error), repairable=True)
            continue
        if result is None:
            continue
        known = _in_table(run, condition)
        if known == [] and care.owns_origin(run):
            yield Fault(
                "evaluations", "tables/evaluations/_delta_log", f"it lacks what {place} has", 0, repairable=True
            )
        elif known not in ([], None, [result]):
            yield Fault("evaluation", place, "it differs from the row in evaluations", repairable=True)


def _in_table(run: Run, condition: str | None) -> list[Evaluation] | None:
    """The newest such evaluation that the table has, if it has one; None where it cannot be read."""
    purpose = "training" if condition is None else "condition"
    try:
        rows = tables.read(run, "evaluations").to_pylist()
    except DataError:  # said of the table itself
        return None
    chosen = [row for row in rows if (row["purpose"], row["condition"]) == (purpose, condition)]
    newest = sorted(chosen, key=lambda row: row["policy_version"])[-1:]
    return [
        Evaluation(
            episodes=row["episodes"],
            seed=row["seed"],
            **{name: Estimate(row[name], row[f"{name}_standard_error"]) for name in evaluation.EVALUATED},
        )
        for row in newest
    ]
