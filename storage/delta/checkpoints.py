"""Checkpoints of a table's log: all that its commits say up to one of them, in a Parquet file.

With them a long table opens as quickly as a short one. They repeat what the commits say, which stay. The library would
give a checkpoint its name before it is on disk, so it is made in a draft. Readers find it by its name; the hint
`_last_checkpoint`, which could name one that is not there, is left out.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from deltalake import DeltaTable

from t6gps.storage import durable

EVERY_N = 10
"""Commits from one checkpoint to the next."""
KEPT_N = 2
"""The newest, and one for whoever is reading."""
ENDING, DIGITS_N = ".checkpoint.parquet", 20


def kept(log: Path) -> list[Path]:
    """The checkpoints of a log, here or in an object store, oldest first."""
    return sorted(log.glob(f"{'[0-9]' * DIGITS_N}{ENDING}"))


def commits(log: Path) -> list[Path]:
    """The commits of a log, oldest first. Whatever else lies there is none, such as a copy of one."""
    return sorted(log.glob(f"{'[0-9]' * DIGITS_N}.json"))


def version(path: Path) -> int:
    """The number of the commit with which a checkpoint ends."""
    return int(path.name.removesuffix(ENDING))


def write(table: Path) -> None:
    """Write the checkpoint of a table's newest commit, whole or not at all; once this returns it survives a crash.

    DeltaError or OSError where that cannot be.
    """
    log, draft = table / "_delta_log", durable.hidden(table)
    shutil.rmtree(draft, ignore_errors=True)  # of a process that was killed
    (draft / log.name).mkdir(parents=True)
    try:
        newest = next((path.name for path in reversed(kept(log))), "")
        for entry in log.iterdir():
            if entry.name >= newest:
                durable.link(entry, draft / log.name / entry.name)
        DeltaTable(str(draft)).create_checkpoint()
        made = kept(draft / log.name)[-1]
        durable.sync(made)
        made.replace(log / made.name)
        durable.sync(log)
        for old in kept(log)[:-KEPT_N]:
            old.unlink()
    finally:
        shutil.rmtree(draft)
