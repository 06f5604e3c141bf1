"""The door to runs below a root of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, final

import pyarrow as pa

from t6gps.service.api import asking
from t6gps.service.api.asking import Parameters, Warn
from t6gps.service.launch import control, launchers
from t6gps.service.launch import job as records
from t6gps.service.launch.control import JobLine, Standing
from t6gps.service.launch.fetch import FolderSource, Source
from t6gps.service.steering import events, requests
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training import evaluation, origin, policies, summary
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import RunSummary
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.storage.sql import query
from t6gps.storage.sql.query import Head


@final
@dataclass(frozen=True)
class Here:
    """Runs below a root, and the jobs of whoever asks."""

    root: Path

    def runs(self) -> list[RunSummary]:
        """All runs by name. RunError where there is no such root."""
        if not catalog.whole(self.root).is_dir():
            raise RunError(
                f"there is no folder {self.root} that could hold runs; train a first one, or give another --root"
            )
        return [summary.summary(run) for run in catalog.list_runs(self.root)]

    def standing(self, name: str) -> Standing:
        """How a run is, and the job that trains it."""
        return control.standing(self.root, name, records.find(self.root, name))

    def scale(self, name: str, workers: int, deadline_s: float) -> Status:
        """Give a running run so many workers; its status then."""
        return control.scale(self.root, name, records.find(self.root, name), workers, deadline_s)

    def pause(self, name: str, deadline_s: float) -> Status:
        """Take all workers from a running run; its status then."""
        return requests.pause(self._run(name), deadline_s)

    def unpause(self, name: str, deadline_s: float) -> Status:
        """Give a paused run what it had; its status then."""
        return requests.unpause(self._run(name), deadline_s)

    def stop(self, name: str, deadline_s: float, warn: Callable[[str], object]) -> str:
        """Stop a run or its job; how it is then, in words."""
        return control.stop(self.root, name, records.find(self.root, name), deadline_s, warn)

    def history(self, name: str) -> Sequence[Event]:
        """What happened to a run."""
        return events.read(self._run(name))

    def follow(self, name: str) -> Iterator[Event]:
        """What happened to a run, and what happens."""
        return events.follow(self._run(name))

    def jobs(self) -> list[JobLine]:
        """The jobs of whoever asks, of all roots."""
        return [control.line(job) for job in records.jobs()]

    def logs(self, name: str, follow: bool) -> Iterator[str]:
        """What a job has written."""
        job = control.named(name, records.find(self.root, name), records.jobs())
        return launchers.serving(job).logs(job, follow)

    def table(self, name: str, table: str) -> pa.Table:
        """A table. An error for a run that is not whole."""
        run = self._run(name)
        origin.configured(run)
        tables.files(run)
        return tables.read(run, table)

    def episode(self, name: str, number: int, evaluation: int | None) -> Episode:
        """An episode of training, or of an evaluation."""
        return tables.episode(self._run(name), number, evaluation)

    def policy(self, name: str, version: int | None) -> PolicySnapshot:
        """The policy of a version, the newest by default."""
        return policies.load(self._run(name), version)

    def evaluation(self, name: str) -> Evaluation | None:
        """What the last policy did without noise; None before the training has ended."""
        return evaluation.kept(self._run(name))

    def head(self, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Head:
        """The first rows of the result of one SELECT over a run, or over those that match a pattern."""
        return query.head(asking.question(self.root, runs, sql, parameters, warn))

    def write(self, runs: str, sql: str, parameters: Parameters, form: str, sink: BinaryIO, warn: Warn) -> None:
        """Write the result of such a SELECT as arrow, parquet, csv or json."""
        query.write(asking.question(self.root, runs, sql, parameters, warn), form, sink)

    @contextmanager
    def source(self, name: str) -> Iterator[tuple[Source, str]]:
        """Where the files of a run come from, and the run's name."""
        job = records.find(self.root, name)
        if job is None:
            yield FolderSource(self._run(name)), name
            return
        with launchers.serving(job).source(job) as source:
            yield source, job.run

    @contextmanager
    def at_hand(self, name: str) -> Iterator[Run]:
        """The run itself."""
        yield self._run(name)

    def _run(self, name: str) -> Run:
        return catalog.open_run(self.root, name)
