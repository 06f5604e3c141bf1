"""Repairing a run: everything is done in a draft beside it first, then the files that differ get their places.

Nothing is deleted: damaged files go to RUN/damaged. A repair that fails changes nothing. One that is killed while files
get their places leaves each file old or new; repairing again ends it.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from t6gps.storage import catalog, durable, schema
from t6gps.storage.care import losses, mending
from t6gps.storage.care.fault import Fault
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, parquet
from t6gps.storage.errors import RunError

REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room beside it"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "get permission to write in it and beside it"),
}
"""What helps against an error of the system."""


@dataclass(frozen=True)
class Repaired:
    """What was done to a run, in sentences, and the faults that it has still."""

    sentences: list[str]
    left: list[Fault]


def repair(run: Run, copy: Run | None, verify: Callable[[Run], list[Fault]]) -> Repaired:
    """Mend a run that nobody uses. RunError where somebody does, for a copy of another, or one that takes no files.

    DataError for a run of a later version.

    verify   all faults of a run
    """
    with catalog.locked(run), catalog.unevaluated(run):
        _check_version(run)
        faults = verify(run)
        if not faults:
            return Repaired([], [])
        try:
            with durable.draft(run.path) as folder:
                sentences = _mended(run, Run(folder), copy, faults, verify)
                durable.sync_tree(folder)
                _put_in_place(folder, run.path)
        except OSError as error:
            remedy = REMEDIES.get(error.errno or 0, "mend that, and repair again")
            raise RunError(f"cannot repair run {run.name}: {error}; nothing is lost; {remedy}") from error
        return Repaired(sentences, verify(run))


def _check_version(run: Run) -> None:
    """DataError for a run of a later version, whose columns would look like damage."""
    for file in sorted(run.tables.glob("*/*.parquet")):
        try:
            version = parquet.version(str(file))
        except (pa.ArrowException, OSError):  # which is what there is to repair
            continue
        if version > schema.SCHEMA_VERSION:
            raise log.newer(run, version)


def _mended(
    run: Run, draft: Run, copy: Run | None, faults: list[Fault], verify: Callable[[Run], list[Fault]]
) -> list[str]:
    hidden = shutil.ignore_patterns(".*")
    shutil.copytree(run.path, draft.path, dirs_exist_ok=True, copy_function=durable.link, ignore=hidden)
    sentences = mending.without_obstacles(draft)
    wrong = mending.without_checkpoints(draft, faults)
    if wrong or sentences:
        faults = verify(draft)
    sentences += mending.told(wrong, faults)
    if copy is not None:
        unsound = verify(copy)
        for take in (mending.from_copy, mending.tables_from_copy):
            sentences += take(draft, copy, faults, unsound)
            faults = verify(draft)
    for way in (mending.rebuilt_logs, mending.from_spool, losses.without):
        done = way(draft, faults)
        if done:
            faults = verify(draft)
        sentences += done
    return sentences


def _put_in_place(draft: Path, run: Path) -> None:
    """Make the run's files those of the draft: what was set aside first, then what is new, then what has gone."""
    wanted, there = (set(_files(folder)) for folder in (draft, run))
    for place in sorted(wanted, key=lambda place: (place.parts[0] != mending.DAMAGED, place)):
        if place not in there or not (draft / place).samefile(run / place):
            _make_way(run / place, run)
            (draft / place).replace(run / place)
    for place in sorted(there - wanted, reverse=True):
        if not (run / place).is_dir():  # which it has become by now
            (run / place).unlink(missing_ok=True)
    for folder in (path for path in sorted(draft.rglob("*")) if path.is_dir()):
        (run / folder.relative_to(draft)).mkdir(exist_ok=True)
    for folder in sorted((path for path in run.rglob("*") if path.is_dir()), reverse=True):
        if not any(folder.iterdir()) and not (draft / folder.relative_to(run)).exists():
            folder.rmdir()
        else:
            durable.sync(folder)
    durable.sync(run)


def _make_way(path: Path, run: Path) -> None:
    """Let a file have its place, where a file is instead of a folder, or the reverse; both are set aside by now."""
    for folder in reversed(path.relative_to(run).parents):
        if (run / folder).is_file():
            (run / folder).unlink()
        (run / folder).mkdir(exist_ok=True)
    if path.is_dir():
        shutil.rmtree(path)


def _files(folder: Path) -> Iterator[Path]:
    """Files by their paths in a folder, without hidden ones: locks, and what is not finished."""
    for path in folder.rglob("*"):
        place = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in place.parts):
            yield place
