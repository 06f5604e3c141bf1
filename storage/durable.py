"""Files that survive a crash: written under a hidden name, forced to disk, then renamed into place."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

_DISCARDED = ".discarded"


def sync(path: Path) -> None:
    """Force a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hidden(path: Path) -> Path:
    """The sibling of `path` that stands for it while it is not finished; readers ignore it."""
    return path.with_name(f".{path.name}.partial")


def publish(path: Path) -> None:
    """Give the finished hidden sibling of the file or folder `path` its name: whole or not at all, even after
    a crash.

    A file replaces its predecessor in one step. A folder's predecessor must have been discarded.
    """
    unfinished = hidden(path)
    sync(unfinished)
    unfinished.replace(path)
    sync(path.parent)


def sweep(parent: Path) -> None:
    """Remove what `discard` has left in a folder because it was cut off."""
    for doomed in parent.glob(f".*{_DISCARDED}"):
        shutil.rmtree(doomed, ignore_errors=True)


def discard(folder: Path) -> None:
    """Remove a folder so that nobody ever sees half of it under its name."""
    doomed = folder.with_name(f".{folder.name}{_DISCARDED}")
    shutil.rmtree(doomed, ignore_errors=True)
    folder.replace(doomed)
    shutil.rmtree(doomed)
