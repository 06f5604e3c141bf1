"""What a damaged run goes without: damaged parts are set aside, with whatever would be of no use without them.

Iterations are kept up to the first that is damaged, since each builds on those before. A run that is resumed makes the
others again, to the same bytes. Evaluations are kept up to the first that is damaged, or whose policy has gone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from t6gps.storage import checkpoint, durable, schema, spool
from t6gps.storage.care import delta_files
from t6gps.storage.care.fault import Fault, within
from t6gps.storage.care.mending import DAMAGED, set_aside
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints

APART = ("spool", "checkpoints", "evaluation")
"""Parts that a run can do without."""


def without(draft: Run, faults: Iterable[Fault]) -> list[str]:
    """Set aside what is damaged; what is lost, and how it comes again."""
    draft.tables.mkdir(exist_ok=True)
    apart = [fault for fault in faults if fault.part in APART]
    for fault in apart:
        set_aside(draft, fault.place)
    lost = _iterations(draft, _first(faults, schema.OF_ITERATIONS))
    lost += _evaluations(draft, _first(faults, schema.OF_EVALUATIONS))
    return [f"{fault.place} is set aside in {DAMAGED}/: {_again(draft, fault)}" for fault in apart] + lost


def _again(draft: Run, fault: Fault) -> str:
    """What becomes of a part that is set aside."""
    states = checkpoint.kept(draft.checkpoints)
    if fault.part == "checkpoints":
        if not states:
            return "there is no other one, so that a run that is resumed begins anew, to the same bytes"
        return f"{within(draft, states[max(states)])} serves when the run is resumed"
    if fault.part == "spool":
        if spool.iteration_of(Path(fault.place)) < max(states, default=0):
            return "its iteration is finished, and nothing needs it"
        return "its episode is sampled again when the run is resumed"
    if fault.place.startswith("conditions/"):
        return "it is evaluated again when the study is run again"
    return "it is evaluated again when the run is resumed"


def _first(faults: Iterable[Fault], tables: Mapping[str, object]) -> int | None:
    """The first number that is damaged; all are where a log cannot be read."""
    known = [
        0 if fault.number is None else fault.number
        for fault in faults
        if fault.part in tables and (fault.number is not None or "_delta_log" in fault.place)
    ]
    return min(known, default=None)


def _iterations(draft: Run, first: int | None) -> list[str]:
    if first is None:
        return []
    for table in schema.OF_ITERATIONS:
        _cut(draft, table, first)
    for iteration, path in checkpoint.kept(draft.checkpoints).items():
        if iteration > first:
            set_aside(draft, within(draft, path))
    found = delta_files.opened(draft, "evaluations")
    for entry in found.files:
        delta_files.examine(draft, found, entry)
    later = [row["evaluation_id"] or 0 for row in delta_files.rows(found) if (row["policy_version"] or 0) > first]
    lost = f"iterations from {first} on are set aside in {DAMAGED}/: resume the run, which makes them again"
    return [lost, *_evaluations(draft, min(later, default=None))]


def _evaluations(draft: Run, first: int | None) -> list[str]:
    if first is None:
        return []
    for table in schema.OF_EVALUATIONS:
        _cut(draft, table, first)
    for place in ("evaluation.json", "conditions"):  # what they repeat
        set_aside(draft, place)
    return [f"evaluations from {first} on are set aside in {DAMAGED}/: resume the run, or use t6gps eval"]


def _cut(draft: Run, table: str, first: int) -> None:
    """Leave a table those files alone whose numbers are smaller. No checkpoint of its log is of these alone."""
    folder = draft.tables / table
    for state in checkpoints.kept(folder / "_delta_log"):
        set_aside(draft, within(draft, state))
    entries = checkpoints.commits(folder / "_delta_log")
    numbers = [_number(entry) for entry in entries]
    end = next((k for k, number in enumerate(numbers) if number is None or number >= first), len(entries))
    for commit in reversed(entries[end:]):  # with those that add no file: a log has no gaps
        set_aside(draft, within(draft, commit))
    if not checkpoints.commits(folder / "_delta_log"):
        set_aside(draft, f"tables/{table}/_delta_log")
    for path in sorted(folder.glob("*.parquet")):
        number = delta_files.number_of(path.name)
        if number is not None and number >= first:
            set_aside(draft, within(draft, path))


def _number(commit: Path) -> int | None:
    """The number of the file that a commit adds; -1 for one that adds none, None where it cannot be read."""
    try:
        actions = [durable.parsed(line) for line in commit.read_text(encoding="utf-8").splitlines()]
        return max((int(action["txn"]["version"]) for action in actions if "txn" in action), default=-1)
    except (OSError, ValueError, TypeError, LookupError):
        return None
