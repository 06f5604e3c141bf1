"""Files that survive a crash: written under a hidden name, forced to disk, then renamed into place.

A file or folder that one process alone writes has one hidden name (`hidden`, `publish`). A folder that several
processes may make at once is built in a `draft` of its own; one rename gives it its name, or finds the name taken.
Whoever reads a file of JSON back takes it for anything (`parsed`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_PARTIAL, _DISCARDED = ".partial", ".discarded"
_ABANDONED_S = 24 * 3600.0
"""A draft in which nothing has been made for so long belongs to no process."""
_TAKEN = (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR)
"""How a rename says that its target is there: a folder that holds something, or no folder."""
DEEPEST_N = 100
"""Brackets in each other in a file of a run, whose own have less than ten: deeper ones exhaust the stack of readers."""
_DEEP = f"it has brackets more than {DEEPEST_N} deep"
_log = logging.getLogger(__name__)


def sync(path: Path) -> None:
    """Force a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Force a folder and everything in it to disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def sha256(file: Path) -> str:
    """The SHA-256 of a file's content, which is read in pieces."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def parsed(text: str | bytes) -> Any:
    """What JSON says. ValueError for text that is none, or has brackets more than DEEPEST_N deep."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(_DEEP) from None
    level: list[object] = [value]
    for _ in range(DEEPEST_N):
        level = [part for whole in level for part in _parts(whole)]
        if not level:
            return value
    raise ValueError(_DEEP)


def _parts(value: object) -> Iterable[object]:
    """What a list or an object of JSON holds."""
    return value if isinstance(value, list) else value.values() if isinstance(value, dict) else ()


def link(source: str | Path, target: str | Path) -> None:
    """Give a file another name, too; a copy where the file system has no such names."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def hidden(path: Path) -> Path:
    """The sibling of `path` that stands for it while it is not finished; readers ignore it."""
    return path.with_name(f".{path.name}{_PARTIAL}")


def publish(path: Path) -> None:
    """Give the finished hidden sibling of the file or folder `path` its name: whole or not at all, even after
    a crash.

    A file replaces its predecessor in one step. A folder's predecessor must have been discarded.
    """
    unfinished = hidden(path)
    sync(unfinished)
    unfinished.replace(path)
    sync(path.parent)


def replace(path: Path, content: bytes) -> None:
    """Give the file `path` this content, whole or not at all; of many who do so at once, one after the other does."""
    unfinished = _unique(path, _PARTIAL)
    try:
        unfinished.write_bytes(content)
        sync(unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    sync(path.parent)


@contextmanager
def draft(path: Path) -> Iterator[Path]:
    """A new hidden folder beside `path`, known to this caller alone; what has not been claimed is removed."""
    folder = _unique(path, _PARTIAL)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # it has its name by now, or is of no use


def claim(folder: Path, path: Path) -> bool:
    """Give a finished folder that is on disk the name `path`; False, and nothing changed, when something has it.

    Of many processes on machines that share the file system, one succeeds: a rename is one step, and replaces neither a
    file nor a folder that holds something.
    """
    try:
        folder.rename(path)
    except OSError as error:
        if folder.exists():
            if error.errno in _TAKEN:
                return False
            raise
        if not path.is_dir():  # else a file server has repeated what it had done already
            raise
    sync(path.parent)
    return True


def sweep(parent: Path) -> None:
    """Remove what was cut off in a folder: discarded folders, and drafts that were abandoned a day ago.

    What cannot be removed is left, and said in the log: it may be another user's.
    """
    for doomed in parent.glob(f".*{_DISCARDED}"):
        _sweep(doomed)
    for folder in parent.glob(f".*{_PARTIAL}"):
        try:  # both times are those of the file system, whatever clock this machine has
            age_s = parent.stat().st_mtime - folder.stat().st_mtime
        except FileNotFoundError:  # claimed meanwhile
            continue
        if age_s > _ABANDONED_S and folder.is_dir():
            _sweep(folder)


def discard(folder: Path) -> None:
    """Remove a folder so that nobody ever sees half of it under its name."""
    doomed = _unique(folder, _DISCARDED)
    folder.replace(doomed)
    _remove(doomed)


def _unique(path: Path, ending: str) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}{ending}")


def _sweep(folder: Path) -> None:
    try:
        _remove(folder)
    except OSError as error:
        _log.info("%s is left over and cannot be removed: %s", folder, error)


def _remove(folder: Path) -> None:
    """Remove a hidden folder, perhaps beside others who sweep it."""

    def judge(_call: object, _path: str, info: tuple[type[BaseException], BaseException, object]) -> None:
        error = info[1]
        # Others remove it as well; or a file server keeps what is open in it, and the next sweep takes that.
        if not (isinstance(error, OSError) and error.errno in (errno.ENOENT, errno.ENOTEMPTY)):
            raise error

    shutil.rmtree(folder, onerror=judge)
