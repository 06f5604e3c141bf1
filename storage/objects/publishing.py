"""Copying a run into an object store, so that its readers see whole iterations at any moment.

Objects appear one after the other, and each whole. So data go first and the entry of the log that names them after,
`episodes` and `evaluations` last of the tables, a checkpoint's DONE last of its files. Objects that never change are
created only where there is none; one that is there already must be the same, or it belongs to another run.

What is left to copy follows from both logs. A copy that was cut off is continued by copying again.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from t6gps.storage import checkpoint, durable, schema
from t6gps.storage.errors import RunError, StoreError
from t6gps.storage.objects import store
from t6gps.storage.objects.place import ObjectPath

FIXED = ("config.json", "origin.json", "ground")
"""What a run is created with; it says whose an object is."""
OF_THE_PROCESS = ("request.json", "pool/published.json")
"""What is never copied: it is for the process that runs the run."""
AT_WORK = ("spool", "pool", "figures", "damaged")
"""What changes while a run is at work, or can be made again."""
LAST = ("episodes", "evaluations")
"""Tables whose readers expect all others."""
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class _Step:
    """A file that is to be copied. `created` ones never change; the others take the place of what is there."""

    file: str
    created: bool = True


def probe(root: ObjectPath) -> None:
    """See that objects can be made below a root, and that none replaces another unasked. StoreError where they can.

    Without that, two writers may both believe that their entry of a log is the one that is kept.
    """
    import obstore

    trial = root / f".probe-{secrets.token_hex(8)}"
    _put(trial, b"1", created=True)
    try:
        _put(trial, b"2", created=True)
    except FileExistsError:
        return
    finally:
        with store.asking(root.bucket, str(trial)):
            obstore.delete(root.client(), trial.key)
    raise StoreError(
        f"{store.access().name} ignores If-None-Match: it let one object replace another that was to be kept, so "
        "commits could be lost; publish to a store that refuses it, such as Amazon S3, SeaweedFS or MinIO"
    )


def check_same(run: Path, target: ObjectPath) -> None:
    """RunError where the place of a run holds another run, or one that has gone further."""
    _check_same(run, target, target.below())


def publish(
    run: Path, target: ObjectPath, without: tuple[str, ...] = (), progress: Progress = lambda done, total: None
) -> None:
    """Copy what is left to copy of the run in a folder, which may be at work.

    without    files and folders of it that are not copied
    progress   is told the files that are copied, and all that are

    RunError where another run is there, StoreError where the store refuses or is away.
    """
    there = target.below()
    _check_same(run, target, there)
    steps = _steps(run, there, (*OF_THE_PROCESS, *without))
    for done, step in enumerate(steps):
        progress(done, len(steps))
        _copy(run, target, step, there)
    progress(len(steps), len(steps))
    _forget_states(run, target, there)


def fetch(source: ObjectPath, folder: Path, progress: Progress) -> None:
    """Copy a run from a store into a folder that is empty. StoreError, or FileNotFoundError for an object that goes."""
    import obstore

    files = source.below()
    for done, file in enumerate(files):
        progress(done, len(files))
        copy, place = folder / file, source / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        with copy.open("wb") as opened, store.asking(source.bucket, str(place)):
            opened.writelines(obstore.get(source.client(store.WRITE_S), place.key).stream())
    progress(len(files), len(files))


def iterations(run: Path) -> int:
    """How many iterations a run has by the log of `episodes`, here or in a store."""
    commits = len(list((run / "tables" / "episodes" / "_delta_log").glob("*.json")))
    return max(0, commits - 1)  # the first makes the table


def _check_same(run: Path, target: ObjectPath, there: Mapping[str, int]) -> None:
    another = RunError(f"{target} holds another run of that name; choose another name with --run, or another prefix")
    fixed = [file for file in there if file.startswith(FIXED)]
    entries = [file for file in there if "/_delta_log/" in file]
    newest = {PurePosixPath(file).parent: file for file in sorted(entries)}.values()
    for file in (*fixed, *entries):
        if not (run / file).is_file():
            if file in entries and all((run / each).is_file() for each in fixed):
                raise RunError(
                    f"{target} has more of the run than {run}: {file}; copy it from there, and go on with it"
                )
            raise another
        if (run / file).stat().st_size != there[file]:
            raise another
    for file in (*fixed, *newest):
        if (run / file).read_bytes() != (target / file).read_bytes():
            raise another


def _steps(run: Path, there: Mapping[str, int], without: tuple[str, ...]) -> list[_Step]:
    """What is left to copy, in order.

    What is written later is looked at earlier: a checkpoint and an evaluation's file before the tables that they
    follow, `episodes` before the tables that it follows. So nothing is copied without what it refers to.
    """
    states = [f"checkpoints/{path.name}" for path in checkpoint.kept(run / "checkpoints").values()]
    others = [_Step(file, created=False) for file in _others(run, without)]
    last = {table: _entries(run, table) for table in LAST}
    tables = {table: _entries(run, table) for table in schema.TABLES if table not in LAST} | last
    steps = [_Step(file) for file in _files(run) if file.startswith(FIXED) and file not in there]
    for table, entries in tables.items():
        left = (entry for entry in entries if entry.relative_to(run).as_posix() not in there)
        steps += [_Step(file) for entry in left for file in _named(run, table, entry)]
    steps += others
    for state in (state for state in states if f"{state}/DONE" not in there):
        files = (_Step(f"{state}/{name}", created=False) for name in ("arrays.npz", "manifest.json"))
        steps += [*files, _Step(f"{state}/DONE")]
    return steps


def _others(run: Path, without: tuple[str, ...]) -> Iterator[str]:
    apart = (*FIXED, "tables", "checkpoints", *without)
    for file in _files(run):
        if not any(file == each or file.startswith(f"{each}/") for each in apart):
            yield file


def _files(run: Path) -> list[str]:
    """Files by their paths in the run, without hidden ones: locks, and what is not finished."""
    places = (path.relative_to(run) for path in sorted(run.rglob("*")) if path.is_file())
    return [place.as_posix() for place in places if not any(part.startswith(".") for part in place.parts)]


def _entries(run: Path, table: str) -> list[Path]:
    return sorted((run / "tables" / table / "_delta_log").glob("*.json"))


def _named(run: Path, table: str, entry: Path) -> Iterator[str]:
    """The files that an entry of a log adds, then the entry."""
    for line in entry.read_text(encoding="utf-8").splitlines():
        action = json.loads(line)
        if "add" in action:
            yield f"tables/{table}/{action['add']['path']}"
    yield entry.relative_to(run).as_posix()


def _copy(run: Path, target: ObjectPath, step: _Step, there: Mapping[str, int]) -> None:
    """Copy a file. RunError where another one is there that was to be kept."""
    source, copy = run / step.file, target / step.file
    try:
        content = _content(source)
    except FileNotFoundError:
        if step.file.startswith("tables/"):
            raise
        return  # the run has replaced it meanwhile, and says so by another
    if not step.created and there.get(step.file) == len(content) and durable.sha256(copy) == _sha256(content):
        return
    try:
        _put(copy, content, step.created)
    except FileExistsError:
        if durable.sha256(copy) != _sha256(content):
            raise RunError(
                f"{copy} is of another run, or of this one as it went on elsewhere; choose another name or prefix"
            ) from None


def _put(copy: ObjectPath, content: bytes | mmap.mmap, created: bool) -> None:
    """Make an object; FileExistsError where one is to be created and there is one."""
    import obstore

    mode: Literal["create", "overwrite"] = "create" if created else "overwrite"
    with store.asking(copy.bucket, str(copy)):
        obstore.put(copy.client(store.WRITE_S), copy.key, content, mode=mode, use_multipart=False)


def _content(file: Path) -> bytes | mmap.mmap:
    """The content of a file, of which no more is in memory than is being sent."""
    with file.open("rb") as opened:
        if not file.stat().st_size:
            return b""
        return mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)


def _sha256(content: bytes | mmap.mmap) -> str:
    return hashlib.sha256(content).hexdigest()


def _forget_states(run: Path, target: ObjectPath, there: Mapping[str, int]) -> None:
    """Remove the checkpoints that the run itself has removed by now, their DONE first."""
    import obstore

    kept = checkpoint.kept(run / "checkpoints")
    first = f"checkpoints/{kept[min(kept)].name}/" if kept else ""
    old = sorted(file for file in there if file.startswith("checkpoints/") and file < first)
    with store.asking(target.bucket, str(target)):
        for file in old:
            obstore.delete(target.client(), (target / file).key)
