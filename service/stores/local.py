"""The store of a root that this program reads itself: questions are answered in this process."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from t6gps.service.api import asking
from t6gps.service.api.asking import Parameter, Parameters
from t6gps.service.stores.store import Store, StoredRun
from t6gps.storage import catalog, tables
from t6gps.storage.sql.inprocess import InProcess
from t6gps.storage.store import windows
from t6gps.storage.store.episode import StoredEpisode
from t6gps.storage.store.result import Result
from t6gps.storage.store.windows import CACHE_BYTES_N, Windows

_log = logging.getLogger(__name__)


@final
@dataclass(frozen=True)
class LocalStore(Store):
    """The runs below a root."""

    root: Path
    _engines: InProcess = field(default_factory=InProcess, repr=False, compare=False)

    def runs(self) -> list[StoredRun]:
        return [StoredRun(self, run.name) for run in catalog.list_runs(self.root)]

    def check(self, name: str) -> None:
        catalog.open_run(self.root, name)

    def sql(self, sql: str, /, runs: str = "*", **parameters: Parameter) -> Result:
        return self._result(sql, runs, parameters)

    def windows(
        self,
        columns: Sequence[str],
        *,
        length: int,
        where: str | None = None,
        runs: str = "*",
        cache_bytes: int = CACHE_BYTES_N,
    ) -> Windows:
        def ask(sql: str, parameters: Mapping[str, int]) -> Result:
            return self._result(sql, runs, parameters)

        return windows.windows(ask, lambda name: catalog.open_run(self.root, name), columns, length, where, cache_bytes)

    def episode(self, run: str, number: int, columns: Sequence[str] | None) -> StoredEpisode:
        found = tables.episode(catalog.open_run(self.root, run), number, columns=columns)
        return StoredEpisode(found.frames, found.summary.to_pylist()[0])

    def _result(self, sql: str, runs: str, parameters: Parameters) -> Result:
        return Result(lambda: self._engines.answered(asking.question(self.root, runs, sql, parameters, _log.warning)))
