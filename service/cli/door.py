"""What commands ask of runs, the same for a root of this machine (`here`) and for a server (`far`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import pyarrow as pa

from t6gps.service.api.asking import Parameters, Warn
from t6gps.service.cli.here import Here
from t6gps.service.launch.control import JobLine, Standing
from t6gps.service.launch.fetch import Source
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import RunSummary
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.storage.sql.query import Head

if TYPE_CHECKING:
    from t6gps.service.remote.client import Client


class Door(Protocol):
    """A root's runs, by their names or those of their jobs. Errors are those of the functions behind it."""

    def runs(self) -> list[RunSummary]: ...

    def standing(self, name: str) -> Standing: ...

    def scale(self, name: str, workers: int, deadline_s: float) -> Status: ...

    def pause(self, name: str, deadline_s: float) -> Status: ...

    def unpause(self, name: str, deadline_s: float) -> Status: ...

    def stop(self, name: str, deadline_s: float, warn: Callable[[str], object]) -> str: ...

    def history(self, name: str) -> Sequence[Event]: ...

    def follow(self, name: str) -> Iterator[Event]: ...

    def jobs(self) -> list[JobLine]: ...

    def logs(self, name: str, follow: bool) -> Iterator[str]: ...

    def table(self, name: str, table: str) -> pa.Table: ...

    def episode(self, name: str, number: int, evaluation: int | None) -> Episode: ...

    def policy(self, name: str, version: int | None) -> PolicySnapshot: ...

    def evaluation(self, name: str) -> Evaluation | None: ...

    def head(self, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Head: ...

    def write(self, runs: str, sql: str, parameters: Parameters, form: str, sink: BinaryIO, warn: Warn) -> None: ...

    def source(self, name: str) -> AbstractContextManager[tuple[Source, str]]: ...

    def at_hand(self, name: str) -> AbstractContextManager[Run]: ...


@contextmanager
def opened(root: Path, server: str | None) -> Iterator[Door]:
    """The door to the runs below `root`, or to those of a server. ConfigError where its client is not installed."""
    if server is None:
        yield Here(root)
        return
    with connected(server) as client:
        from t6gps.service.cli.far import Far

        yield Far(client)


@contextmanager
def connected(server: str) -> Iterator[Client]:
    """The client of a server. ConfigError where it is not installed."""
    try:
        from t6gps.service.remote.client import Client
    except ModuleNotFoundError as error:
        raise ConfigError(f"--server needs {error.name}; install it with: pip install 't6gps[server]'") from None
    with Client(server) as client:
        yield client
