"""The runs under a root folder, and where each keeps what.

ROOT/NAME/config.json     the configuration, as the run was created with
ROOT/NAME/tables/         frames, episodes, iterations, classes: Delta tables
ROOT/NAME/spool/          episodes of the iteration being sampled
ROOT/NAME/checkpoints/    states of the learner
ROOT/NAME/figures/        pictures drawn from the tables
ROOT/NAME/pool/           scale request, status and decisions of a running run
ROOT/NAME/bundles/        episodes that failed, with what is needed to run them alone
"""

from __future__ import annotations

import difflib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from t6gps.storage import durable
from t6gps.storage.errors import RunError

NAME_LENGTH_N = 64
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
    def bundles(self) -> Path:
        return self.path / "bundles"

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


def create(root: Path, name: str, config_text: str) -> Run:
    """Create the run `name` under `root` (made when missing) with its configuration and empty folders.

    The run appears whole or not at all. Raises RunError when the name is refused or taken, or when the root
    cannot be written.
    """
    run = Run(root / check_name(name))
    if run.path.exists():
        raise RunError(f"{run.path} exists already; choose another name with --run, or add --resume")
    if "%" in str(root.absolute()):
        raise RunError(f"the root's path must have no '%', which the Delta tables would decode; found {root}")
    draft = Run(durable.hidden(run.path))
    try:
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK | os.X_OK):
            raise PermissionError(f"no permission to write in {root}")
        shutil.rmtree(draft.path, ignore_errors=True)  # of a creation that was cut off
        for folder in (draft.tables, draft.spool, draft.checkpoints, draft.figures):
            folder.mkdir(parents=True)
        draft.config_path.write_text(config_text, encoding="utf-8")
        durable.sync(draft.config_path)
        durable.publish(run.path)
    except OSError as error:
        shutil.rmtree(draft.path, ignore_errors=True)
        raise RunError(
            f"cannot create run {name!r} under {root}: {error}; the root must be a writable folder"
        ) from error
    return run


def discard_unused(run: Run) -> None:
    """Remove a run that is as it was created: no worker ever started for it, nothing was sampled."""
    used = (run.tables, run.spool, run.checkpoints, run.figures)
    if not run.pool.exists() and not any(any(folder.iterdir()) for folder in used):
        durable.discard(run.path)


def open_run(root: Path, name: str) -> Run:
    """The existing run `name` under `root`. Raises RunError naming the runs that exist, the closest first."""
    run = Run(root / check_name(name))
    if run.config_path.is_file():
        return run
    names = [other.name for other in list_runs(root)]
    if not names:
        raise RunError(f"there is no run {name!r}: {root} holds no runs; check the root, or start a run")
    closest = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {closest[0]!r}? " if closest else ""
    raise RunError(f"there is no run {name!r} in {root}; {hint}runs: {', '.join(names)}")


def list_runs(root: Path) -> list[Run]:
    """All runs under `root` by name; none when the root does not exist."""
    if not root.is_dir():
        return []
    folders = sorted(path for path in root.iterdir() if _NAME.fullmatch(path.name))
    return [Run(path) for path in folders if (path / "config.json").is_file()]


@contextmanager
def locked(run: Run) -> Iterator[None]:
    """Hold the run for this process alone; the lock ends with the process, however it ends.

    Raises RunError naming the process that holds it.
    """
    with (run.path / ".lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise RunError(
                f"run {run.name} is in use by process {file.read() or 'unknown'}; wait for it to end, or stop it"
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def process_of(run: Run) -> int | None:
    """The process that has the run locked, None when there is none."""
    with (run.path / ".lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            return int(file.read() or 0)
    return None
