"""A run as its user sees it."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import final

import pyarrow as pa
import pyarrow.compute as pc

from t6gps.service import config as configuration
from t6gps.service.api import asking
from t6gps.service.api.asking import Parameter
from t6gps.service.api.policy import Policy
from t6gps.service.config import Config
from t6gps.service.steering import events, requests, status
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training import evaluation, policies
from t6gps.service.training.evaluation import Evaluation
from t6gps.storage import catalog, tables
from t6gps.storage.sql import inprocess


@final
@dataclass(frozen=True)
class Run:
    """A run: its configuration, data, policies and workers. `train`, `open_run` and `runs` give one.

    path   its folder; `storage.catalog` says what lies where in it
    """

    path: Path

    @property
    def name(self) -> str:
        """Its name."""
        return self.path.name

    @property
    def config(self) -> Config:
        """The configuration that it was created with."""
        return configuration.kept(self._folder)

    @property
    def evaluation(self) -> Evaluation | None:
        """What its last policy did without noise; None before the training has ended."""
        return evaluation.kept(self._folder)

    def query(self, sql: str, /, **parameters: Parameter) -> pa.Table:
        """The result of one SELECT over its tables (docs/queries.md), with values for the SQL's $names.

        Only committed iterations are seen. QueryError for SQL that is refused or wrong.
        """
        return inprocess.ask(asking.of_run(self._folder, sql, parameters))

    def table(self, name: str, columns: list[str] | None = None, where: pc.Expression | None = None) -> pa.Table:
        """The committed rows of a table, bit for bit; units are in the metadata of its fields.

        columns   their names, all by default
        where     rows to keep, such as pyarrow.compute.field("iteration") == 3; all by default

        DataError for an unknown table or column.
        """
        return tables.read(self._folder, name, columns, where)

    def episode(self, number: int) -> pa.Table:
        """The frames of one episode, T + 1 rows. DataError naming the episodes that exist."""
        return tables.episode(self._folder, number).frames

    def policy(self, version: int | None = None) -> Policy:
        """The policy of a version that is kept, the newest by default. RunError naming the versions that are."""
        return Policy(policies.load(self._folder, version))

    def status(self) -> Status:
        """How the run is: its state, workers, and who waits for whom. RunError when it never had workers."""
        return status.status(self._folder)

    def scale(self, workers: int) -> Status:
        """Give the running run that many workers, 0 pauses it, and wait until it has them; its status then.

        RunError when it is not running, the number is not allowed, or the workers are not there within 30 s.
        """
        return requests.scale(self._folder, workers)

    def pause(self) -> Status:
        """Give the running run no workers, and let it remember how many it had. Status and errors as `scale`."""
        return requests.pause(self._folder)

    def unpause(self) -> Status:
        """Give the paused run what it had before. Status and errors as `scale`."""
        return requests.unpause(self._folder)

    def stop(self) -> None:
        """Stop the running run as Ctrl-C does, and wait until it has ended; `resume` continues it.

        RunError when it is not running, or has not ended within a minute.
        """
        requests.stop(self._folder)

    def events(self) -> list[Event]:
        """What happened to its workers and episodes, each with time and reason; none without workers."""
        return events.read(self._folder)

    @property
    def _folder(self) -> catalog.Run:
        return catalog.Run(catalog.whole(self.path))


def open_run(path: str | PathLike[str]) -> Run:
    """The run in a folder, such as "runs/rough". RunError naming the runs that are beside it."""
    folder = Path(path)
    return Run(catalog.open_run(folder.parent, folder.name).path)


def runs(root: str | PathLike[str] = "runs") -> list[Run]:
    """All runs below `root` by name; none when the folder does not exist."""
    return [Run(folder.path) for folder in catalog.list_runs(Path(root))]
