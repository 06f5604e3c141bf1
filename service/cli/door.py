"""What commands ask of runs, the same for a root of this machine and for a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol, final

import pyarrow as pa

from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.service.training import evaluation, origin, summary
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import RunSummary
from t6gps.storage import catalog, tables
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.sql import query
from t6gps.storage.sql.query import Head

if TYPE_CHECKING:
    from t6gps.service.remote.client import Client


class Door(Protocol):
    """A root's runs, by their names. Errors are those of the functions behind it."""

    def runs(self) -> list[RunSummary]: ...

    def status(self, name: str) -> Status: ...

    def scale(self, name: str, workers: int, deadline_s: float) -> Status: ...

    def table(self, name: str, table: str) -> pa.Table: ...

    def evaluation(self, name: str) -> Evaluation | None: ...

    def head(self, name: str, sql: str) -> Head: ...

    def write(self, name: str, sql: str, form: str, sink: BinaryIO) -> None: ...


@final
@dataclass(frozen=True)
class Local:
    """Runs below a root of this machine."""

    root: Path

    def runs(self) -> list[RunSummary]:
        """All runs by name. RunError where there is no such root."""
        if not catalog.whole(self.root).is_dir():
            raise RunError(
                f"there is no folder {self.root} that could hold runs; train a first one, or give another --root"
            )
        return [summary.summary(run) for run in catalog.list_runs(self.root)]

    def status(self, name: str) -> Status:
        """How a run is."""
        return statuses.status(catalog.open_run(self.root, name))

    def scale(self, name: str, workers: int, deadline_s: float) -> Status:
        """Give a running run so many workers; its status then."""
        return requests.scale(catalog.open_run(self.root, name), workers, deadline_s)

    def table(self, name: str, table: str) -> pa.Table:
        """A table. An error for a run that is not whole."""
        run = catalog.open_run(self.root, name)
        origin.configured(run)
        tables.files(run)
        return tables.read(run, table)

    def evaluation(self, name: str) -> Evaluation | None:
        """What the last policy did without noise; None before the training has ended."""
        return evaluation.kept(catalog.open_run(self.root, name))

    def head(self, name: str, sql: str) -> Head:
        """The first rows of the result of one SELECT."""
        return query.head(catalog.open_run(self.root, name), sql)

    def write(self, name: str, sql: str, form: str, sink: BinaryIO) -> None:
        """Write the result of one SELECT as arrow, csv or json."""
        query.write(catalog.open_run(self.root, name), sql, form, sink)


@contextmanager
def opened(root: Path, server: str | None) -> Iterator[Door]:
    """The door to the runs below `root`, or to those of a server. ConfigError where its client is not installed."""
    if server is None:
        yield Local(root)
        return
    with connected(server) as client:
        yield client


@contextmanager
def connected(server: str) -> Iterator[Client]:
    """The client of a server. ConfigError where it is not installed."""
    try:
        from t6gps.service.remote.client import Client
    except ModuleNotFoundError as error:
        raise ConfigError(f"--server needs {error.name}; install it with: pip install 't6gps[server]'") from None
    with Client(server) as client:
        yield client
