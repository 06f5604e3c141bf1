"""A store: what can be asked of many runs, wherever they are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from t6gps.service.api.asking import Parameter
from t6gps.storage.store.episode import StoredEpisode
from t6gps.storage.store.result import Result
from t6gps.storage.store.windows import CACHE_BYTES_N, Windows


class Store(ABC):
    """The runs of a root. `open_store` gives one; it can be sent to another process, which opens its own files."""

    @abstractmethod
    def runs(self) -> list[StoredRun]:
        """All runs by name, damaged ones included."""

    def run(self, name: str) -> StoredRun:
        """A run by its name. RunError naming the runs that there are."""
        self.check(name)
        return StoredRun(self, name)

    @abstractmethod
    def sql(self, sql: str, /, runs: str = "*", **parameters: Parameter) -> Result:
        """What one SELECT over runs gives (docs/queries.md), with values for the SQL's $names.

        runs   the name of one, or a shell pattern such as "rough-*". Of many, those that are damaged are left out,
               each with a warning in the log
        """

    @abstractmethod
    def windows(
        self,
        columns: Sequence[str],
        *,
        length: int,
        where: str | None = None,
        runs: str = "*",
        cache_bytes: int = CACHE_BYTES_N,
    ) -> Windows:
        """Pieces of episodes for training: all windows of `length` control steps in a row.

        columns       of the table `frames`; with `action` or `action_mean` no window has the last state
        where         SQL that each of its rows meets, over the columns of `frames` and `episodes`
        runs          as for `sql`
        cache_bytes   of decoded columns that a process keeps; what does not fit is read again

        ConfigError for a length below 1, DataError for an unknown column, QueryError for a wrong condition.
        """

    @abstractmethod
    def check(self, name: str) -> None:
        """Raise RunError unless there is a run of that name."""

    @abstractmethod
    def episode(self, run: str, number: int, columns: Sequence[str] | None) -> StoredEpisode:
        """An episode of a run, as `StoredRun.episode`."""


@final
@dataclass(frozen=True)
class StoredRun:
    """A run of a store."""

    store: Store
    name: str

    def sql(self, sql: str, /, **parameters: Parameter) -> Result:
        """What one SELECT over this run gives."""
        return self.store.sql(sql, self.name, **parameters)

    def episode(self, number: int, columns: Sequence[str] | None = None) -> StoredEpisode:
        """An episode of training as arrays, such as `nodes` [T + 1, 12, 3]. DataError naming the episodes there are.

        columns   of its frames; all by default
        """
        return self.store.episode(self.name, number, columns)

    def windows(
        self, columns: Sequence[str], *, length: int, where: str | None = None, cache_bytes: int = CACHE_BYTES_N
    ) -> Windows:
        """Its windows, as `Store.windows`."""
        return self.store.windows(columns, length=length, where=where, runs=self.name, cache_bytes=cache_bytes)
