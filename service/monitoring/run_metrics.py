"""What a single run measures: from the status that its process writes, from its tables, and from its folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service.monitoring import metrics
from t6gps.service.monitoring.metrics import Metric
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.service.training import summary
from t6gps.service.training.summary import Row
from t6gps.storage.catalog import Run


class Sample(NamedTuple):
    """A number of a metric; `label` is the value of its further label."""

    metric: Metric
    value: float
    label: str | None = None


def of_process(run: Run, pid: int | None) -> Iterator[Sample]:
    """What the run's process says; `pid` is that of the one at work, None without. RunError for a damaged status."""
    yield Sample(metrics.RUN_UP, pid is not None)
    said = statuses.last_said(run)
    if said is None or pid not in (None, said["pid"]):  # the process at work has said nothing yet
        return
    yield Sample(metrics.STATUS_TIME, said["time_s"])
    yield from _one_of(metrics.RUN_STATE, said["state"])
    yield from _counts(said)
    if pid is not None:
        yield from _at_present(said)


def _counts(said: Status) -> Iterator[Sample]:
    """What counts up in the life of a process."""
    for phase, spent_s in said.get("phases_s", {}).items():
        if phase in metrics.RUN_PHASES:
            yield Sample(metrics.PHASE_SECONDS, spent_s, phase)
    processes, episodes = said.get("processes", {}), said.get("episodes", {})
    yield Sample(metrics.STARTS, processes.get("started", 0))
    for cause, counter in metrics.LOSSES.items():
        yield Sample(metrics.REPLACEMENTS, processes.get(counter, 0), cause)
    yield Sample(metrics.EPISODES, episodes.get("committed", 0))
    hung_n, lost_n = episodes.get("expired", 0), episodes.get("lost", 0)
    failed = {"error": episodes.get("failures", 0) - hung_n, "hang": hung_n, "lost": lost_n}
    for cause in metrics.FAILURES:
        yield Sample(metrics.EPISODE_FAILURES, failed[cause], cause)
    for cause in metrics.DROPS:
        yield Sample(metrics.DROPPED, episodes.get(cause, 0), cause)


def _at_present(said: Status) -> Iterator[Sample]:
    """What holds while a process is at work."""
    yield from _one_of(metrics.RUN_PHASE, said.get("phase", ""))
    if (age_s := said.get("durable_for_s")) is not None:
        yield Sample(metrics.EPISODE_TIME, said["time_s"] - age_s)
    yield Sample(metrics.WORKERS_WANTED, said.get("wanted", 0))
    yield Sample(metrics.WORKERS_READY, said.get("ready", 0))
    phases = [worker["phase"] for worker in said["workers"]]
    for phase in metrics.WORKER_PHASES:
        yield Sample(metrics.WORKERS, phases.count(phase), phase)
    yield Sample(metrics.BACKLOG, said.get("backlog", 0))
    yield Sample(metrics.IN_FLIGHT, said.get("bytes_in_flight", 0))


def _one_of(metric: Metric, value: str) -> Iterator[Sample]:
    """1 for one of the values that the metric's label may have, 0 for the others."""
    return (Sample(metric, each == value, each) for each in metric.values)


def of_folder(run: Run, at_work: bool) -> Iterator[Sample]:
    """What lies in the run's folder beside its tables; its spool while a process is `at_work`."""
    if at_work:
        size_n = 0
        for file in run.spool.glob("*/[!.]*"):
            with suppress(FileNotFoundError):  # its iteration was committed just now
                size_n += file.stat().st_size
        yield Sample(metrics.SPOOL, size_n)
    yield Sample(metrics.QUARANTINED, sum(1 for _ in run.bundles.glob("[!.]*.json")))


@dataclass(frozen=True)
class Progress:
    """What the configuration and the table `iterations` say; `last` is the newest row, None before the first."""

    planned: int
    done: int
    steps: int
    last: Row | None


def progress(run: Run) -> Progress:
    """How far a run is. ConfigError, RunError or DataError for one that is damaged."""
    rows = summary.iterations(run)
    steps = sum(int(row["steps"] or 0) for row in rows)
    return Progress(configuration.kept(run).run.iterations, len(rows), steps, rows[-1] if rows else None)


def of_progress(known: Progress) -> Iterator[Sample]:
    """How far a run is, and what its last iteration has reached."""
    yield Sample(metrics.ITERATIONS_PLANNED, known.planned)
    yield Sample(metrics.ITERATIONS, known.done)
    yield Sample(metrics.CONTROL_STEPS, known.steps)
    if known.last is None:
        return
    took_s = sum(known.last[column] or 0.0 for column in ("sampling_s", *(phase.duration_column for phase in PHASES)))
    if took_s > 0:
        yield Sample(metrics.STEP_RATE, (known.last["steps"] or 0) / took_s)
    for metric, column in (
        (metrics.COST, "cost"),
        (metrics.SPEED, "forward_speed_m_per_s"),
        (metrics.STUCK, "stuck_share_by_distance"),
    ):
        if (value := known.last[column]) is not None:
            yield Sample(metric, value)
