"""The log of a table as it lies on disk: commits without a gap, and checkpoints that say what these say."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from t6gps.storage import durable
from t6gps.storage.care.fault import Fault, within
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints, log
from t6gps.storage.objects import place

_Action = tuple[str, Any]
"""An entry of a commit: its kind, and what it says."""
_USED = {
    "add": ("path", "size", "stats"),
    "txn": ("appId", "version"),
    "metaData": ("schemaString",),
    "protocol": ("minReaderVersion", "minWriterVersion"),
}
"""What readers use of the actions of a commit."""
_MANY = ("add", "txn")
"""Actions of which a table has several, by the first that is used of them; of the others the last one holds."""
CONTRADICTED = "it does not say what the commits of the log say"
"""Of a checkpoint: one of the two was altered."""
_State = dict[tuple[str, object], tuple[object, ...]]


@dataclass
class Commits:
    """What the log of a table says.

    sums      SHA-256 of files by their names; commits of earlier versions have none
    lacking   what commits have not of files, by their names, and those of this version have
    newest    the checkpoint that its readers begin with, None where there is none
    faults    what is wrong
    """

    sums: dict[str, str] = field(default_factory=dict)
    lacking: dict[str, str] = field(default_factory=dict)
    newest: Path | None = None
    faults: list[Fault] = field(default_factory=list)


def read(run: Run, table: str) -> Commits:
    """Read the log of a table whole. StoreError where its object store does not answer."""
    folder = run.tables / table / "_delta_log"
    repeated = {checkpoints.version(path): path for path in checkpoints.kept(folder)}
    found, state = Commits(newest=repeated[max(repeated)] if repeated else None), _State()
    there = {int(path.stem): path for path in checkpoints.commits(folder)}
    for version in range(max([*there, *repeated], default=-1) + 1):
        path = there.get(version, folder / f"{version:020d}.json")
        try:
            actions = _actions(path)
            found.sums |= _sums(actions)
            found.lacking |= _lacking(actions, found.sums)
            _replay(state, actions)
        except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
            what = "the commit is missing" if version not in there else f"the commit cannot be read: {error!r}"
            found.faults.append(Fault(table, within(run, path), what, repairable=True))
        if version in repeated and not found.faults:
            found.faults += _compared(run, table, repeated[version], state)
    return found


def _actions(commit: Path) -> list[_Action]:
    """The actions of a commit by their kinds; some error for one that is damaged."""
    content = commit.read_text(encoding="utf-8")
    actions = [action for line in content.splitlines() for action in durable.parsed(line).items()]
    if not actions:
        raise ValueError("it is empty")
    return actions


def _sums(actions: Iterable[_Action]) -> dict[str, str]:
    digest = next((values.get(log.SHA256) for kind, values in actions if kind == "commitInfo"), None)
    return {values["path"]: digest for kind, values in actions if kind == "add" and digest is not None}


def _lacking(actions: Iterable[_Action], sums: Mapping[str, str]) -> dict[str, str]:
    """What the commit of a file has not; ValueError for one that leaves out rows, as no version does."""
    lacking = dict[str, str]()
    for add in (values for kind, values in actions if kind == "add"):
        if add.get("deletionVector") is not None:
            raise ValueError(f"it leaves out rows of {add['path']}")
        stats = durable.parsed(add.get("stats") or "null")
        if not isinstance(stats, dict) or not isinstance(stats.get("numRecords"), int):
            lacking[add["path"]] = "number of rows"
        if add["path"] not in sums:
            lacking[add["path"]] = "SHA-256"
    return lacking


def _replay(state: _State, actions: Iterable[_Action]) -> None:
    """Let actions change what readers know of a table."""
    for kind, values in actions:
        if kind in _USED:
            used = tuple(values.get(name) for name in _USED[kind])
            state[kind, used[0] if kind in _MANY else None] = used
        elif kind == "remove":
            state.pop(("add", values["path"]), None)


def _compared(run: Run, table: str, checkpoint: Path, state: _State) -> list[Fault]:
    """What is wrong with a checkpoint, after whose commits a table is in this state."""
    said = _State()
    try:
        for row in pq.read_table(place.source(checkpoint), columns=list(_USED)).to_pylist():
            _replay(said, [(kind, values) for kind, values in row.items() if values is not None])
    except (pa.ArrowException, OSError, ValueError) as error:
        place.answers(checkpoint, error)
        what = (str(error).splitlines() or [type(error).__name__])[0][: log.MESSAGE_LENGTH_N]
    else:
        what = "" if said == state else CONTRADICTED
    return [Fault(table, within(run, checkpoint), what, repairable=True)] if what and checkpoint.exists() else []
