"""The runs under a root folder, and where each keeps what.

ROOT/NAME/config.json     the configuration, as the run was created with
ROOT/NAME/origin.json     what made the run: versions, commit, time, digest of the ground
ROOT/NAME/ground/         the file of its ground, where it has one
ROOT/NAME/tables/         frames, episodes, iterations, classes: Delta tables
ROOT/NAME/spool/          episodes of the iteration being sampled
ROOT/NAME/checkpoints/    states of the learner
ROOT/NAME/figures/        pictures drawn from the tables
ROOT/NAME/request.json    what somebody asks of the process that runs it
ROOT/NAME/pool/           status, events and decisions of a running run
ROOT/NAME/bundles/        episodes that failed, with what is needed to run them alone
ROOT/.cache/NAME/         what queries over many runs keep of it; may be deleted at any time
"""

from __future__ import annotations

import difflib
import errno
import fcntl
import fnmatch
import itertools
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TextIO, cast

from t6gps.storage import durable
from t6gps.storage.errors import RunError
from t6gps.storage.objects import place

NAME_LENGTH_N = 64
GLANCE_S = 0.5
"""Somebody who only looks whether a run is in use holds its lock for less."""
NO_FILES: Mapping[str, bytes] = MappingProxyType({})
_EVALUATING = ".evaluating"
_WILD = frozenset("*?[")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*", re.ASCII)


@dataclass(frozen=True)
class Run:
    """One run: a folder, and the names inside it."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def tables(self) -> Path:
        return self.path / "tables"

    @property
    def spool(self) -> Path:
        return self.path / "spool"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

    @property
    def pool(self) -> Path:
        return self.path / "pool"

    @property
    def request(self) -> Path:
        return self.path / "request.json"

    @property
    def bundles(self) -> Path:
        return self.path / "bundles"

    @property
    def ground(self) -> Path:
        return self.path / "ground"

    @property
    def cache(self) -> Path:
        return self.path.parent / ".cache" / self.name

    @property
    def config_path(self) -> Path:
        return self.path / "config.json"


def check_name(name: str) -> str:
    """Return `name` when it can name a run, else raise RunError with the rule it breaks."""
    if len(name) > NAME_LENGTH_N or not _NAME.fullmatch(name):
        raise RunError(
            f"a run's name must be 1 to {NAME_LENGTH_N} letters, digits, '-', '_' or '.', the first one a "
            f"letter or digit; found {name[: 2 * NAME_LENGTH_N]!r}; choose another with --run"
        )
    return name


def whole(root: Path) -> Path:
    """A root as every process knows it, wherever it works: absolute, without '~', links or '..'.

    An object store's is s3://BUCKET/PREFIX, however many slashes a Path has left of it. Raises RunError for one that
    has no such path, or one that the tables could not open.
    """
    if place.is_object(root):
        return place.whole(root)
    try:
        path = root.expanduser().resolve()
    except RuntimeError as error:
        raise RunError(f"the root {root} leads nowhere: {error}; give another --root") from None
    if "%" in str(path):
        raise RunError(
            f"the root's path must have no '%', which the Delta tables would decode, found {path}; rename it"
        )
    return path


def folder(path: Path) -> Path:
    """A root, or a run's folder, of a command that writes. StoreError for one in an object store."""
    if place.is_object(path):
        raise place.only_read(place.whole(path))
    return path


def create(
    root: Path, name: str, config_text: str, files: Mapping[str, bytes] = NO_FILES, numbered: bool = False
) -> Run:
    """Create the run `name` under `root` (made when missing) with its configuration and empty folders.

    files      what else it owns, by paths in the run
    numbered   where the name is taken, the run becomes the first of NAME-2, NAME-3, ... that is free

    The run appears whole or not at all, and of several processes that create one at the same time each gets its own.
    Raises RunError when the name is refused or taken, or when the root cannot be written.
    """
    root, contents = whole(root), {"config.json": config_text.encode(), ".lock": b"", **files}
    with drafted(root, name, "create", numbered) as draft:
        for part in (draft.tables, draft.spool, draft.checkpoints, draft.figures):
            part.mkdir()
        for file, content in contents.items():
            path = draft.path / file
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        return claimed(draft, root, name, "create", numbered)


def copy(run: Run, root: Path, name: str) -> Run:
    """Copy a run that nobody uses, whole or not at all. Raises RunError as `create`, and where the run is in use."""
    root = whole(root)
    with unused(run), unevaluated(run), drafted(root, name, "copy") as draft:
        shutil.copytree(run.path, draft.path, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".*"))
        (draft.path / ".lock").touch()
        return claimed(draft, root, name, "copy")


def move(run: Run, root: Path, name: str) -> Run:
    """Give a run that nobody uses another name or root, in one step. Raises RunError as `copy`.

    Between file systems it is copied, then removed.
    """
    root = folder(whole(root))
    with locked(run), unevaluated(run):
        try:
            root.mkdir(parents=True, exist_ok=True)
            if durable.claim(run.path, root / check_name(name)):
                durable.sync(run.path.parent)
                _uncache(run)
                return Run(root / name)
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise RunError(f"cannot move run {run.name} to {root}: {error}; the root must be writable") from error
        else:
            raise _taken(root / name, "move")
    moved = copy(run, root, name)
    remove(run)
    return moved


def remove(run: Run) -> None:
    """Remove a run that nobody uses; nobody ever sees half of it. Raises RunError where it is in use."""
    with locked(run), unevaluated(run):
        durable.discard(run.path)
        _uncache(run)


def _uncache(run: Run) -> None:
    """Remove what the cache has of a run that has gone. What is left would be of no use, and do no harm."""
    shutil.rmtree(run.cache, ignore_errors=True)


def size(run: Run) -> int:
    """Bytes of a run's files."""
    return sum(place.below(run.path).values())


def discard_unused(run: Run) -> None:
    """Remove a run that is as it was created: no worker ever started for it, nothing was sampled."""
    used = (run.tables, run.spool, run.checkpoints, run.figures)
    if not run.pool.exists() and not any(any(folder.iterdir()) for folder in used):
        durable.discard(run.path)


@contextmanager
def drafted(root: Path, name: str, what: str, numbered: bool = False) -> Iterator[Run]:
    """A hidden folder for a run of that name. RunError where the name is taken, or the root cannot be written."""
    path = folder(root) / check_name(name)
    if not numbered and os.path.lexists(path):
        raise _taken(path, what)
    try:
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK | os.X_OK):
            raise PermissionError(f"no permission to write in {root}")
        with durable.draft(path) as draft:
            durable.sweep(root)
            yield Run(draft)
    except OSError as error:
        raise RunError(
            f"cannot {what} run {name!r} under {root}: {error}; the root must be a writable folder with room"
        ) from error


def claimed(draft: Run, root: Path, name: str, what: str, numbered: bool = False) -> Run:
    """The run that a draft becomes, under its name or the first number that is free. RunError when it is taken."""
    durable.sync_tree(draft.path)
    numbers = itertools.count(2) if numbered else ()
    for free in itertools.chain([name], (f"{name}-{number}" for number in numbers)):
        path = root / check_name(free)
        if not os.path.lexists(path) and durable.claim(draft.path, path):
            return Run(path)
    raise _taken(root / name, what)


def _taken(path: Path, what: str) -> RunError:
    remedy = " with --run, or add --resume" if what == "create" else ""
    return RunError(f"{path} exists already; choose another name{remedy}")


def open_run(root: Path, name: str) -> Run:
    """The existing run `name` under `root`. Raises RunError naming the runs that exist, the closest first."""
    root = whole(root)
    run = Run(root / check_name(name))
    if _is_run(run):
        return run
    names = [other.name for other in list_runs(root)]
    if not names:
        raise RunError(f"there is no run {name!r}: {root} holds no runs; check the root, or start a run")
    closest = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {closest[0]!r}? " if closest else ""
    raise RunError(f"there is no run {name!r} in {root}; {hint}runs: {', '.join(names)}")


def matching(root: Path, pattern: str) -> list[Run]:
    """The runs under `root` whose names match a shell pattern such as 'rough-*', by name.

    RunError where none does, with the closest names. A name stands for itself alone, and is refused as by `open_run`.
    """
    if not is_pattern(pattern):
        return [open_run(root, pattern)]
    runs = list_runs(root)
    found = [run for run in runs if fnmatch.fnmatchcase(run.name, pattern)]
    if not found:
        names = [run.name for run in runs]
        closest = difflib.get_close_matches(pattern, names, n=3, cutoff=0.4)
        hint = f"the closest: {', '.join(closest)}; " if closest else ""
        listed = f"{hint}runs: {', '.join(names)}" if names else "it holds no runs"
        raise RunError(f"no run in {whole(root)} matches {pattern!r}; {listed}")
    return found


def is_pattern(name: str) -> bool:
    """True for what may stand for many runs: it has '*', '?' or '['."""
    return not _WILD.isdisjoint(name)


def exists(root: Path, name: str) -> bool:
    """True when there is a run `name` under `root`, damaged or not. RunError for a name that none can have."""
    return _is_run(Run(whole(root) / check_name(name)))


def list_runs(root: Path) -> list[Run]:
    """All runs under `root` by name, damaged ones included; none when the root does not exist."""
    root = whole(root)
    if not root.is_dir():
        return []
    runs = (Run(path) for path in sorted(root.iterdir()) if _NAME.fullmatch(path.name))
    return [run for run in runs if _is_run(run)]


def _is_run(run: Run) -> bool:
    """True for a run, whole or with parts that are missing or may not be read."""
    try:
        return run.config_path.is_file() or run.tables.is_dir()
    except PermissionError:
        return True


@contextmanager
def locked(run: Run) -> Iterator[None]:
    """Hold the run for this process alone; the lock ends with the process, however it ends.

    What was asked of a process that has ended is forgotten. Raises RunError naming the process that holds it, or why
    the run cannot be held.
    """
    with _lock_file(run, "a+") as file:
        deadline = time.monotonic() + GLANCE_S
        while not _locked(file, fcntl.LOCK_EX):
            if time.monotonic() > deadline:
                file.seek(0)
                raise RunError(
                    f"run {run.name} is in use by process {file.read().strip() or 'unknown'}; "
                    "wait for it to end, or stop it"
                )
            time.sleep(GLANCE_S / 20)
        if not _is_of(file, run):
            raise RunError(f"run {run.name} was moved or removed just now; see t6gps runs")
        file.truncate(0)
        run.request.unlink(missing_ok=True)  # before anybody reads whom to ask now
        file.write(f"{os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield


@contextmanager
def unused(run: Run) -> Iterator[None]:
    """Let nobody train the run meanwhile; this writes nothing. Raises RunError where somebody does."""
    if not (run.path / ".lock").exists():  # nobody has ever used it
        yield
        return
    with _lock_file(run, "r") as file:
        if not _locked(file, fcntl.LOCK_SH):
            raise RunError(f"run {run.name} is in use by process {file.read() or 'unknown'}; wait for it to end")
        yield


@contextmanager
def evaluating(run: Run) -> Iterator[None]:
    """Let nobody copy, move or remove the run meanwhile; others may train and evaluate it."""
    with (folder(run.path) / _EVALUATING).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield


@contextmanager
def unevaluated(run: Run) -> Iterator[None]:
    """Let nobody evaluate the run meanwhile; this writes nothing. Raises RunError where somebody does."""
    path = run.path / _EVALUATING
    if not path.exists():  # nobody has ever done so
        yield
        return
    with path.open("r") as file:
        if not _locked(file, fcntl.LOCK_EX):
            raise RunError(f"run {run.name} is in use: somebody evaluates it; wait for that to end")
        yield


def process_of(run: Run) -> int | None:
    """The process that has the run locked, None when there is none or it has not said so yet; this writes nothing."""
    if not (run.path / ".lock").exists():  # nobody has ever used it
        return None
    with _lock_file(run, "r") as file:
        if _locked(file, fcntl.LOCK_SH):
            return None
        words = file.read().split()
        return int(words[0]) if words else None


def _lock_file(run: Run, mode: str) -> TextIO:
    path = folder(run.path) / ".lock"
    try:
        return cast(TextIO, path.open(mode, encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"run {run.name} was moved or removed just now; see t6gps runs") from None
    except OSError as error:
        need = "to read" if mode == "r" else "to write"
        raise RunError(f"run {run.name} cannot be held: {path}: {error.strerror}; get permission {need} it") from error


def _locked(file: TextIO, kind: int) -> bool:
    """Lock a file, False where another process has it. RunError for a file system without locks."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise RunError(
            f"{file.name} cannot be locked: {error.strerror}; keep the root on a file system with locks"
        ) from error
    return True


def _is_of(file: TextIO, run: Run) -> bool:
    """True when it is still the lock file of the run: another may have been created under its name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), (run.path / ".lock").stat())
    except FileNotFoundError:
        return False
