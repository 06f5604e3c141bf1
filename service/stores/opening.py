"""The one door to stored runs, wherever they are."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path

from t6gps.service.stores.local import LocalStore
from t6gps.service.stores.store import Store
from t6gps.storage.errors import RunError


def open_store(root: str | PathLike[str] = "runs") -> Store:
    """The store of a root: a folder. RunError where there is none."""
    place = fspath(root)
    if not Path(place).expanduser().is_dir():
        raise RunError(f"there is no folder {place} that could hold runs; train a first one, or give another root")
    return LocalStore(Path(place))
