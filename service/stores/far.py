"""The store of a server: questions go over the wire, under the token of whoever asks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

from t6gps.service.api.asking import Parameter
from t6gps.service.remote import rows
from t6gps.service.remote.client import Client
from t6gps.service.stores.store import Store, StoredRun
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError
from t6gps.storage.store.episode import StoredEpisode
from t6gps.storage.store.result import Result
from t6gps.storage.store.windows import CACHE_BYTES_N, Windows

_log = logging.getLogger(__name__)
_SUMMARY = "SELECT * EXCLUDE (run) FROM episodes WHERE episode_id = $number"


@final
@dataclass(frozen=True)
class FarStore(Store):
    """The runs of a server, with the token of T6GPS_TOKEN, which stays out of pickles."""

    url: str
    _client: Client = field(repr=False, compare=False)

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return of, (self.url,)

    def runs(self) -> list[StoredRun]:
        return [StoredRun(self, summary.name) for summary in self._client.runs()]

    def check(self, name: str) -> None:
        catalog.check_name(name)  # whether it is there is said with the first answer

    def sql(self, sql: str, /, runs: str = "*", **parameters: Parameter) -> Result:
        return Result(lambda: rows.opened(self._client, runs, sql, parameters, _log.warning))

    def windows(
        self,
        columns: Sequence[str],
        *,
        length: int,
        where: str | None = None,
        runs: str = "*",
        cache_bytes: int = CACHE_BYTES_N,
    ) -> Windows:
        raise ConfigError(
            f"windows are read from files again and again, and the runs {runs} are at {self.url}; bring them here with "
            f"t6gps fetch RUN --server {self.url} --to ROOT, and open the store of that ROOT"
        )

    def episode(self, run: str, number: int, columns: Sequence[str] | None) -> StoredEpisode:
        frames = self._client.episode(run, number, columns or ())
        return StoredEpisode(frames, self._client.query(run, _SUMMARY, number=number).to_pylist()[0])


def of(url: str) -> FarStore:
    """The store of a server. ServerError for an address that is none, or without a token."""
    client = Client(url)
    return FarStore(client.server.url, client)
