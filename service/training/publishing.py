"""Publishing a run while it is trained: a process beside it copies what is committed, and never holds it up."""

from __future__ import annotations

import logging
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, final

from t6gps.service.steering import published
from t6gps.service.training import publisher
from t6gps.service.training.loop import Observer
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError, StoreUnreachableError, T6GpsError
from t6gps.storage.objects import place, publishing
from t6gps.storage.objects.place import ObjectPath

LAST_WAIT_S = publisher.END_S + 5.0
_log = logging.getLogger(__name__)


def address(text: str | None) -> ObjectPath | None:
    """The root in an object store that a text names, None for none. ConfigError for another address.

    Whether it can be reached from here is not asked.
    """
    if text is None:
        return None
    if not place.is_object(Path(text)):
        raise ConfigError(f"--publish takes s3://BUCKET/PREFIX, found {text!r}; copies to folders are made by t6gps cp")
    return place.addressed(Path(text))


def target(text: str | None) -> ObjectPath | None:
    """As `address`, for a process that will write there. ConfigError also without keys, or without obstore."""
    root = address(text)
    return None if root is None else place.whole(root)


def probe(root: ObjectPath, resumes: bool, warn: Callable[[str], object]) -> None:
    """See that a store takes runs, StoreError where it does not. A run that resumes does so where the store is away."""
    try:
        publishing.probe(root)
    except StoreUnreachableError as error:
        if not resumes:
            raise
        warn(f"{error}; the run resumes, and is published when the store is back")


def check(run: Run, root: ObjectPath) -> None:
    """RunError where the root holds another run of that name; nothing is known of a store that is away.

    A run that is not there yet must find no other one.
    """
    with suppress(StoreUnreachableError):  # `probe` has told of it
        publishing.check_same(run.path, root / run.name)


def check_all(runs: Sequence[Run], root: ObjectPath, warn: Callable[[str], object]) -> None:
    """See that a store takes runs, of which some are not there yet. Errors as `probe` and `check`."""
    probe(root, any(run.path.exists() for run in runs), warn)
    for run in runs:
        check(run, root)


def catch_up(run: Run, root: ObjectPath, progress: publishing.Progress) -> None:
    """Copy what is left to copy of a run, which others may use; a warning says why something is left still."""
    copy, error = root / run.name, None
    try:
        publishing.publish(run.path, copy, publishing.AT_WORK, progress)
    except (T6GpsError, OSError) as trouble:
        error = trouble
    publisher.tell(run, copy, error)
    if error is not None:
        _tell_left(run, root)


@contextmanager
def beside(run: Run, root: ObjectPath | None, observer: Observer) -> Iterator[Observer]:
    """An observer that lets finished iterations be published below a root, None for none.

    At the end it waits for LAST_WAIT_S until everything is there, after an error not at all; it tells what is left.
    """
    if root is None:
        yield observer
        return
    process, done = _Process(run, root / run.name), False
    try:
        yield _Teller(observer, process)
        process.wake()  # also where it has died
        done = process.end(LAST_WAIT_S)
    finally:
        if not done:
            process.end(0.0)
            _tell_left(run, root)


def _tell_left(run: Run, root: ObjectPath) -> None:
    try:
        known = published.standing(run)
    except RunError:  # the command below finds out
        known = None
    try:
        all_n = str(publishing.iterations(run.path))
    except RunError:
        all_n = "unknown"
    there_n = known["iterations"] if known else 0
    reason = f": {known['error']}" if known and known["error"] else ""
    command = ["t6gps", "cp", run.name, run.name, "--root", str(run.path.parent), "--to", str(root)]
    what = f"{there_n} of {all_n} iterations, perhaps without checkpoint and evaluation"
    _log.warning("run %s is published as far as %s%s; finish with: %s", run.name, what, reason, shlex.join(command))


@final
class _Teller:
    """Hands on what an observer is told, and wakes the process that publishes."""

    def __init__(self, observer: Observer, process: _Process) -> None:
        self._observer, self._process = observer, process

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        self._observer.progress(iteration, phase, done, total)

    def finished(self, row: dict[str, Any]) -> None:
        self._process.wake()
        self._observer.finished(row)


@final
class _Process:
    """The process `publisher`, which is started again where it has died."""

    def __init__(self, run: Run, copy: ObjectPath) -> None:
        self._command = [sys.executable, "-P", "-m", publisher.__name__, str(catalog.whole(run.path)), str(copy)]
        self._child = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        child = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True
        )
        assert child.stdin is not None, "it is a pipe"
        os.set_blocking(child.stdin.fileno(), False)
        return child

    def wake(self) -> None:
        """Say that something was committed; this does not wait."""
        if self._child.poll() is not None:
            try:
                self._child = self._started()
            except OSError as error:  # the run goes on, and tries again after the next iteration
                _log.warning("nothing is published now, its process cannot be started: %s", error)
                return
        assert self._child.stdin is not None, "it is a pipe"
        with suppress(BlockingIOError, BrokenPipeError):  # it has lines to read still, or has died just now
            os.write(self._child.stdin.fileno(), b"\n")

    def end(self, wait_s: float) -> bool:
        """Say that nothing more comes, and wait so long at most; True where everything is there."""
        assert self._child.stdin is not None, "it is a pipe"
        with suppress(BrokenPipeError):
            self._child.stdin.close()
        try:
            return self._child.wait(wait_s) == 0
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
            return False
