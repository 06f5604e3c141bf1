"""Copying a run into an object store, so that its readers see whole iterations at any moment.

Objects appear one after the other, and each whole. So data go first and the entry of the log that names them after,
`episodes` and `evaluations` last of the tables, a checkpoint's DONE last of its files. Checkpoints of logs, which say
what the entries say, are not copied. Objects that never change are created only where there is none; one that is there
already must be the same, or it belongs to another run. What the run itself removes goes from the copy, too.

What is left to copy follows from both logs. A copy that was cut off is continued by copying again.
"""

from __future__ import annotations

import hashlib
import mmap
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from t6gps.storage import checkpoint, durable, schema
from t6gps.storage.errors import CheckpointError, RunError, StoreError
from t6gps.storage.objects import store
from t6gps.storage.objects.place import ObjectPath, answers, below

FIXED = ("config.json", "origin.json", "ground")
"""What a run is created with; it says whose an object is."""
OF_THE_PROCESS = ("request.json", "pool/published.json")
"""What is never copied: it is for the process that runs the run."""
AT_WORK = ("spool", "pool", "figures", "damaged")
"""What changes while a run is at work, or can be made again."""
GOING = ("spool/", "bundles/")
"""What a run removes when it is of no more use."""
LAST = ("episodes", "evaluations")
"""Tables whose readers expect all others."""
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class _Step:
    """A file that is to be copied. `created` ones never change; the others take the place of what is there."""

    file: str
    created: bool = True


@dataclass(frozen=True, order=True)
class _Commit:
    """A commit to a table, in the order in which commits are copied: one iteration after the other.

    number   of its iteration or evaluation; of a commit that adds no file, that of the next one that does
    entry    of the log
    files    what it adds, then its entry
    """

    of_evaluations: bool
    number: int
    last: bool
    entry: str
    files: tuple[str, ...]


def probe(root: ObjectPath) -> None:
    """See that objects can be made below a root, and that none replaces another unasked. StoreError where they can.

    Without that, two writers may both believe that their entry of a log is the one that is kept.
    """
    import obstore

    answers(root)  # some stores make a bucket that is written to
    trial = root / f".probe-{secrets.token_hex(8)}"
    with suppress(FileExistsError):  # it was made, and the answer was lost
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
    states = _states(run, target, there)
    there = _removed(target, there, [file for file in there if file.startswith(states)])
    gone = [file for file in there if file.startswith(GOING) and not (run / file).exists()]
    steps = _steps(run, there, states, (*OF_THE_PROCESS, *without))
    for done, step in enumerate(steps):
        progress(done, len(steps))
        _copy(run, target, step, there)
    progress(len(steps), len(steps))
    _removed(target, there, [*gone, *_old_states(run, there)])


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
    """How many iterations a run has by the log of `episodes`, here or in a store. RunError where its end is torn."""
    entries = sorted((run / "tables" / "episodes" / "_delta_log").glob("*.json"), reverse=True)
    numbers = (_said(entry)[0] for entry in entries)
    return next((number + 1 for number in numbers if number is not None), 0)


def _check_same(run: Path, target: ObjectPath, there: Mapping[str, int]) -> None:
    another = RunError(f"{target} holds another run of that name; choose another name or prefix")
    fixed = [file for file in there if file.startswith(FIXED)]
    entries = sorted(file for file in there if "/_delta_log/" in file and file.endswith(".json"))
    newest = {PurePosixPath(file).parent: file for file in entries}.values()
    here = below(run)
    told = [file for file in fixed if not file.startswith("ground/")]  # whose SHA-256 is in origin.json
    if any(here.get(file) != there[file] for file in fixed) or not all(_same(run, target, file) for file in told):
        raise another
    more = [file for file in entries if file not in here]
    if more:
        raise RunError(f"{target} has more of the run than {run}: {more[0]}; copy it from there, and go on with it")
    if any(here[file] != there[file] for file in entries) or not all(_same(run, target, file) for file in newest):
        raise another


def _same(run: Path, target: ObjectPath, file: str) -> bool:
    return (run / file).read_bytes() == (target / file).read_bytes()


def _states(run: Path, target: ObjectPath, there: Mapping[str, int]) -> tuple[str, ...]:
    """The learner's checkpoints that are left to copy, as folders: those that are sound, and not there as they are."""
    kept = [f"checkpoints/{path.name}/" for path in checkpoint.kept(run / "checkpoints").values()]
    left = [state for state in kept if not _is_copied(run, target, state, there)]
    sound = [state for state in left if _is_sound(run / state)]
    return tuple(sound if sound or len(left) < len(kept) else left)  # where none is, the copy says so as the run does


def _is_copied(run: Path, target: ObjectPath, state: str, there: Mapping[str, int]) -> bool:
    """True where a checkpoint is there: DONE has the SHA-256 of the manifest, and that one those of the arrays."""
    sizes = {f"{state}{name}": size for name, size in below(run / state).items()}
    try:
        return sizes.items() <= there.items() and _same(run, target, f"{state}DONE")
    except FileNotFoundError:
        return False  # it has gone meanwhile, here or there


def _is_sound(state: Path) -> bool:
    """False for a checkpoint that is torn, which is of no use in a copy, and for one that has gone meanwhile."""
    try:
        checkpoint.load(state)
    except CheckpointError:
        return False
    return True


def _steps(run: Path, there: Mapping[str, int], states: tuple[str, ...], without: tuple[str, ...]) -> list[_Step]:
    """What is left to copy, in order.

    What is written later is looked at earlier: a checkpoint and an evaluation's file before the tables that they
    follow, `episodes` before the tables that it follows. So nothing is copied without what it refers to.
    """
    others = [_Step(file, created=False) for file in _others(run, without)]
    looked = [_commits(run, table, there) for table in sorted(schema.TABLES, key=lambda table: table not in LAST)]
    commits = sorted(commit for commits in looked for commit in commits)
    steps = [_Step(file) for file in _files(run) if file.startswith(FIXED) and file not in there]
    steps += [_Step(file) for commit in commits for file in commit.files]
    steps += others
    for state in states:
        steps += [_Step(f"{state}{name}") for name in ("arrays.npz", "manifest.json", "DONE")]
    return steps


def _commits(run: Path, table: str, there: Mapping[str, int]) -> list[_Commit]:
    """The commits to a table that are not there."""
    entries = sorted((run / "tables" / table / "_delta_log").glob("*.json"))
    commits, number = list[_Commit](), sys.maxsize
    for entry in reversed(entries):
        file = entry.relative_to(run).as_posix()
        if file in there:
            continue
        added, paths = _said(entry)
        number = number if added is None else added
        data = (f"tables/{table}/{path}" for path in paths)
        commits.append(_Commit(table in schema.OF_EVALUATIONS, number, table in LAST, file, (*data, file)))
    return commits


def _said(entry: Path) -> tuple[int | None, list[str]]:
    """The iteration or evaluation that a commit adds, None for one that makes a table or gives it columns; its files.

    RunError where it is torn.
    """
    try:
        actions = [durable.parsed(line) for line in entry.read_text(encoding="utf-8").splitlines()]
        number = next((int(action["txn"]["version"]) for action in actions if "txn" in action), None)
        return number, [str(action["add"]["path"]) for action in actions if "add" in action]
    except (ValueError, LookupError, TypeError) as error:
        raise RunError(f"{entry} is no commit: {error!r}; mend the run with t6gps repair") from None


def _others(run: Path, without: tuple[str, ...]) -> Iterator[str]:
    apart = (*FIXED, "tables", "checkpoints", *without)
    for file in _files(run):
        if not any(file == each or file.startswith(f"{each}/") for each in apart):
            yield file


def _files(run: Path) -> list[str]:
    """Files by their paths in the run, without hidden ones: locks, and what is not finished."""
    return [file for file in sorted(below(run)) if not any(part.startswith(".") for part in file.split("/"))]


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


def _old_states(run: Path, there: Mapping[str, int]) -> list[str]:
    """Files of the checkpoints that the run itself has removed by now, once a later one is there."""
    folders = (f"checkpoints/{path.name}/" for path in checkpoint.kept(run / "checkpoints").values())
    first = min((folder for folder in folders if f"{folder}DONE" in there), default="")  # or else all would be gone
    return [file for file in there if file.startswith("checkpoints/") and file < first]


def _removed(target: ObjectPath, there: dict[str, int], files: list[str]) -> dict[str, int]:
    """Remove objects, a checkpoint's DONE before its other files; those that are left."""
    import obstore

    with store.asking(target.bucket, str(target)):
        for file in sorted(files):
            obstore.delete(target.client(), (target / file).key)
    return {file: size for file, size in there.items() if file not in files}
