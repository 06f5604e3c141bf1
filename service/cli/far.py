"""The door to the runs of a server."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import BinaryIO, cast, final

import pyarrow as pa

from t6gps.service.api.asking import Parameters, Warn
from t6gps.service.launch.control import JobLine, Standing
from t6gps.service.launch.fetch import Source
from t6gps.service.remote import following, source
from t6gps.service.remote.client import Client
from t6gps.service.remote.source import FarSource
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training import policies
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import RunSummary
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.storage.sql.query import Head


@final
@dataclass(frozen=True)
class Far:
    """Asks the server what `Here` does with a root."""

    client: Client

    def runs(self) -> list[RunSummary]:
        return self.client.runs()

    def standing(self, name: str) -> Standing:
        return self.client.standing(name)

    def scale(self, name: str, workers: int, deadline_s: float) -> Status:
        return self.client.scale(name, workers, deadline_s)

    def pause(self, name: str, deadline_s: float) -> Status:
        return self.client.pause(name, deadline_s)

    def unpause(self, name: str, deadline_s: float) -> Status:
        return self.client.unpause(name, deadline_s)

    def stop(self, name: str, deadline_s: float, warn: Callable[[str], object]) -> str:
        stopped = self.client.stop(name, deadline_s)
        for warning in stopped.warnings:
            warn(warning)
        return stopped.sentence

    def history(self, name: str) -> Sequence[Event]:
        return self.client.history(name)

    def follow(self, name: str) -> Iterator[Event]:
        for update in following.updates(self.client, name):
            if update.kind == "fault":
                raise RunError(str(update.data))
            if update.kind == "pool":
                yield cast(Event, update.data)

    def jobs(self) -> list[JobLine]:
        return self.client.jobs()

    def logs(self, name: str, follow: bool) -> Iterator[str]:
        return following.logs(self.client, name, follow)

    def table(self, name: str, table: str) -> pa.Table:
        return self.client.table(name, table)

    def episode(self, name: str, number: int, evaluation: int | None) -> Episode:
        frames = self.client.episode(name, number, evaluation)
        table, of = ("episodes", "") if evaluation is None else ("evaluation_episodes", "AND evaluation_id = $of")
        parameters = {"number": number} if evaluation is None else {"number": number, "of": evaluation}
        sql = f"SELECT * EXCLUDE (run) FROM {table} WHERE episode_id = $number {of}"
        return Episode(frames, self.client.query(name, sql, **parameters))

    def policy(self, name: str, version: int | None) -> PolicySnapshot:
        chosen = policies.chosen_of(name, self.client.versions(name), version)
        return self.client.policy(name, chosen).snapshot

    def evaluation(self, name: str) -> Evaluation | None:
        return self.client.evaluation(name)

    def head(self, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Head:
        return self.client.head(runs, sql, parameters, warn)

    def write(self, runs: str, sql: str, parameters: Parameters, form: str, sink: BinaryIO, warn: Warn) -> None:
        self.client.write(runs, sql, form, sink, parameters, warn)

    def source(self, name: str) -> AbstractContextManager[tuple[Source, str]]:
        return nullcontext((FarSource(self.client, name), name))

    def at_hand(self, name: str) -> AbstractContextManager[Run]:
        return source.at_hand(self.client, name)
