"""The one door to stored runs, wherever they are."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path

from t6gps.service.stores.local import LocalStore
from t6gps.service.stores.store import Store
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError, RunError


def open_store(root: str | PathLike[str] = "runs") -> Store:
    """The store of a root: a folder, s3://BUCKET/PREFIX, or a server's address such as "https://gps.example.org:8686".

    A server is asked with the token of T6GPS_TOKEN, an object store with the keys of AWS_*. RunError for a folder that
    is not there, ServerError for an address that is none, StoreError for an object store that refuses or is away,
    ConfigError where the client of either is not installed, or keys are missing.
    """
    place = str(root) if isinstance(root, Path) else fspath(root)
    if place.startswith(("http://", "https://")):
        try:
            from t6gps.service.stores import far
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"the store of a server needs {error.name}; install it with: pip install 't6gps[server]'"
            ) from None
        return far.of(place)
    folder = catalog.whole(Path(place))
    if not folder.is_dir():
        raise RunError(f"there is no folder {place} that could hold runs; train a first one, or give another root")
    return LocalStore(folder)
