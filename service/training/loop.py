"""The training loop: sample, keep, learn, commit, checkpoint (paper Alg. 2, once per iteration).

What a crash leaves behind decides where a run resumes. Episodes are in the spool as soon as they are acknowledged; an
iteration's tables are committed once; the checkpoint comes last and the spool is emptied after it. So a resumed run
takes the newest checkpoint, reads the spooled episodes of its iteration, samples the missing ones and learns again:
each step depends on seeds alone, and committing an iteration a second time changes nothing.

In a pipelined run the workers begin with an iteration while the learner is still at work on the one before it. What
they have sampled is in the spool when the iteration's turn comes, which then resumes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from t6gps.learner.phases import PHASES
from t6gps.learner.port import Manifest
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.storage import checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.checkpoint import JSON
from t6gps.storage.delta import iterations
from t6gps.storage.errors import LearnerDiedError, RunError
from t6gps.storage.records import Episode, EpisodePlan, Learned, PolicySnapshot
from t6gps.storage.spool import Spool, read

LEARNER_DEATHS_ALLOWED_N = 3
"""In one iteration."""
COMMIT = "commit"
"""The phase in which an iteration is committed and its checkpoint is written."""
_log = logging.getLogger(__name__)


class Observer(Protocol):
    """Whoever watches a run."""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        """A phase has advanced."""

    def finished(self, row: dict[str, Any]) -> None:
        """An iteration is committed; `row` goes into the iterations table."""


def train(config: Config, run: Run, executor: Executor, observer: Observer) -> None:
    """Run the iterations that are missing, from the newest checkpoint on.

    A learner that dies is replaced by one that resumes there, too; LearnerDiedError when that does not help.
    """
    deaths_n, resumed = 0, False
    while True:
        first = 0
        try:
            latest = checkpoint.load_latest(run.checkpoints)
            if latest is not None:
                first, manifest, arrays = latest
                executor.learner.restore(cast(Manifest, manifest), arrays)
                executor.learner.recall(run)
                if not resumed:
                    executor.ledger.restore(manifest.get("ledger"))
            resumed = True
            for iteration in range(first, config.run.iterations):
                _iterate(config, run, executor, observer, iteration)
                deaths_n = 0
            return
        except LearnerDiedError as error:
            deaths_n += 1
            if deaths_n > LEARNER_DEATHS_ALLOWED_N:
                raise
            _log.warning("%s; another one resumes from the newest checkpoint", error)
            executor.replace_learner()


@dataclass(frozen=True)
class Batch:
    """The episodes of one iteration: planned, the numbers of those in the spool, and who acts in the others."""

    plans: list[EpisodePlan]
    kept: set[int]
    snapshot: PolicySnapshot

    @property
    def missing(self) -> list[EpisodePlan]:
        return [plan for plan in self.plans if plan.episode_id not in self.kept]


def _batch(config: Config, executor: Executor, spool: Spool) -> Batch:
    plans = seeding.training_plans(config, spool.iteration)
    snapshot = executor.learner.policy(plans[0].policy_version)
    return Batch(plans, spool.numbers(), snapshot)


def _iterate(config: Config, run: Run, executor: Executor, observer: Observer, iteration: int) -> None:
    durations: dict[str, float] = {}
    with _timed(durations, "sampling_s"):
        spool = Spool(run.spool, iteration)
        batch = _batch(config, executor, spool)
        plans, kept = batch.plans, batch.kept

        def keep(episode: Episode) -> None:
            spool.append(episode)
            kept.add(episode.episode_id)
            executor.feed(episode)
            observer.progress(iteration, "sample", len(kept), len(plans))

        observer.progress(iteration, "sample", len(kept), len(plans))
        executor.ledger.worked |= bool(kept)
        executor.feed_spooled([spool.path(number) for number in sorted(kept)])
        executor.sample(batch.missing, batch.snapshot, keep)
        files = [spool.path(number) for number in sorted(kept)]
    if not kept:
        raise RunError(
            f"every episode of iteration {iteration} is quarantined; see {run.bundles}, mend, remove, --resume"
        )
    if config.run.pipelined and iteration + 1 < config.run.iterations:
        _sample_ahead(config, run, executor, iteration + 1)
    for phase in PHASES:
        with _timed(durations, phase.duration_column):
            for done, total in executor.learn(phase):
                observer.progress(iteration, phase.name, done, total)
    report = executor.learner.report()
    summaries = pa.concat_tables([read(path).summary.take([0]) for path in files]).combine_chunks()
    row: dict[str, Any] = {"iteration": iteration, "policy_version": batch.snapshot.version}
    row |= _sampled(summaries) | report.iteration | durations
    row["left_out"] = len(plans) - len(files)
    row["realised_cost_change"] = _realised(run, batch.snapshot.version, row["cost"])
    policies = [executor.learner.policy()] if iteration else [batch.snapshot, executor.learner.policy()]
    learned = Learned(row, report.classes, report.models, policies)
    iterations.commit(run, iteration, _tended(executor, files), learned)
    state = executor.learner.state()
    manifest = cast(dict[str, JSON], {**state.manifest, "ledger": executor.ledger.state()})
    checkpoint.save(run.checkpoints, iteration + 1, manifest, state.arrays)
    spool.clear()
    observer.finished(row)


def _sample_ahead(config: Config, run: Run, executor: Executor, iteration: int) -> None:
    spool = Spool(run.spool, iteration)
    batch = _batch(config, executor, spool)
    executor.sample_ahead(batch.missing, batch.snapshot, spool.append)


def _tended(executor: Executor, files: Sequence[Path]) -> Iterator[Episode]:
    """Episodes one after the other; the pool is tended meanwhile."""
    for file in files:
        executor.tend(COMMIT)
        yield read(file)


@contextmanager
def _timed(durations: dict[str, float], column: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    durations[column] = time.perf_counter() - start


def _sampled(summary: pa.Table) -> dict[str, Any]:
    """The part of an iteration's row that describes its episodes, from their summaries."""
    result: dict[str, Any] = {"episodes": summary.num_rows, "steps": int(np.sum(summary["steps"].to_numpy()))}
    for column, error in (
        ("cost", "cost_standard_error"),
        ("forward_speed_m_per_s", "forward_speed_standard_error"),
    ):
        result[column], result[error] = mean_and_error(summary[column])
    for column, reported in (
        ("stuck_share", "stuck_share"),
        ("stuck_share_by_distance", "stuck_share_by_distance"),
        ("waypoints_reached", "waypoints_per_episode"),
    ):
        result[reported], _ = mean_and_error(summary[column])
    return result


def _realised(run: Run, version: int, cost: float) -> float | None:
    """What training this version of the policy has changed of the cost (m2/s2); None for the untrained one."""
    if version == 0:
        return None
    before = tables.read(run, "iterations", ["cost"], pc.field("iteration") == version - 1)
    return cost - float(before.column("cost")[0].as_py())


def mean_and_error(column: pa.ChunkedArray) -> tuple[float | None, float | None]:
    """Mean and standard error over the episodes that have a quantity.

    No mean where none has it, no standard error where fewer than two have it.
    """
    values = column.drop_null().to_numpy()
    mean = float(values.mean()) if len(values) else None
    return mean, float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
