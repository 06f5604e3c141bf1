"""The metrics of `/metrics`: names with their base units, types, labels, and what each means.

Labels are bounded. `run` is one of the runs that are shown (`exporter`), all others are one of a few words of the code.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from t6gps.learner.phases import PHASES
from t6gps.service.pool.state import RunState, WorkerPhase


class Kind(StrEnum):
    """Types of Prometheus. A counter begins anew with the process that counts, as Prometheus expects."""

    GAUGE = "gauge"
    COUNTER = "counter"


@dataclass(frozen=True)
class Metric:
    """A metric. One of a run has the label `run`; `label` is a further one, which has one of `values`."""

    name: str
    kind: Kind
    meaning: str
    of_run: bool = True
    label: str | None = None
    values: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of its labels."""
        return ("run",) * self.of_run + (() if self.label is None else (self.label,))


STATES = tuple(state.value for state in RunState if state is not RunState.STOPPED)
WORKER_PHASES = tuple(phase.value for phase in WorkerPhase)
RUN_PHASES = ("starting", "sampling", *(phase.name for phase in PHASES), "commit")
FAILURES = ("error", "hang", "lost")
DROPS = ("duplicates", "late")
LOSSES = {"crash": "crashed", "hang": "hung"}
"""Causes of a replacement, and how the status calls those workers."""

_GAUGE, _COUNTER = Kind.GAUGE, Kind.COUNTER

ROOT_SIZE = Metric("t6gps_root_size_bytes", _GAUGE, "size of the file system with the root", of_run=False)
ROOT_FREE = Metric("t6gps_root_free_bytes", _GAUGE, "of it, what is free for the server's user", of_run=False)
RUNS = Metric("t6gps_runs", _GAUGE, "runs in the root", of_run=False)
RUNS_LEFT_OUT = Metric("t6gps_runs_left_out", _GAUGE, "of these, runs without metrics: beyond the bound", of_run=False)
RUNS_UNREADABLE = Metric("t6gps_runs_unreadable", _GAUGE, "of these, runs that cannot be read whole", of_run=False)

RUN_UP = Metric("t6gps_run_up", _GAUGE, "1 while a process works on the run")
RUN_STATE = Metric(
    "t6gps_run_state", _GAUGE, "1 for the state that its process said last, 0 for others", True, "state", STATES
)
RUN_PHASE = Metric(
    "t6gps_run_phase",
    _GAUGE,
    "1 for what it does at present, 0 for others",
    True,
    "phase",
    RUN_PHASES,
)
STATUS_TIME = Metric("t6gps_status_timestamp_seconds", _GAUGE, "when its process told how it is, Unix time")
EPISODE_TIME = Metric(
    "t6gps_last_episode_timestamp_seconds", _GAUGE, "when the newest episode of its process became durable, Unix time"
)
PHASE_SECONDS = Metric(
    "t6gps_phase_seconds_total",
    _COUNTER,
    "time in each phase: sampling, the learner's, commit",
    True,
    "phase",
    RUN_PHASES,
)
WORKERS_WANTED = Metric("t6gps_workers_wanted", _GAUGE, "workers that it shall have")
WORKERS_READY = Metric("t6gps_workers_ready", _GAUGE, "workers that take plans")
WORKERS = Metric("t6gps_workers", _GAUGE, "workers by what they do", True, "phase", WORKER_PHASES)
STARTS = Metric("t6gps_worker_starts_total", _COUNTER, "workers that were started")
REPLACEMENTS = Metric(
    "t6gps_worker_replacements_total",
    _COUNTER,
    "workers that failed and make room for others",
    True,
    "cause",
    tuple(LOSSES),
)
EPISODES = Metric("t6gps_episodes_total", _COUNTER, "durable episodes, those of evaluations included")
EPISODE_FAILURES = Metric(
    "t6gps_episode_failures_total",
    _COUNTER,
    "attempts at episodes that gave no data; lost ones are not the episode's fault",
    True,
    "cause",
    FAILURES,
)
DROPPED = Metric("t6gps_episodes_dropped_total", _COUNTER, "episodes that came twice or late", True, "cause", DROPS)
QUARANTINED = Metric("t6gps_episodes_quarantined", _GAUGE, "episodes in quarantine: crash bundles that are kept")
BACKLOG = Metric("t6gps_episodes_backlog", _GAUGE, "episodes of the batch that are neither durable nor in quarantine")
IN_FLIGHT = Metric("t6gps_in_flight_bytes", _GAUGE, "size of the episodes under way")
SPOOL = Metric("t6gps_spool_bytes", _GAUGE, "size of durable episodes whose iteration is not committed")

ITERATIONS = Metric("t6gps_iterations_total", _COUNTER, "iterations that are committed")
ITERATIONS_PLANNED = Metric("t6gps_iterations_planned", _GAUGE, "iterations that it shall have")
CONTROL_STEPS = Metric("t6gps_control_steps_total", _COUNTER, "control steps of committed iterations")
STEP_RATE = Metric(
    "t6gps_control_steps_per_second", _GAUGE, "control steps per second of the last iteration, learning included"
)
COST = Metric(
    "t6gps_cost_square_meters_per_square_second", _GAUGE, "mean running cost of the last iteration's episodes"
)
SPEED = Metric(
    "t6gps_forward_speed_meters_per_second", _GAUGE, "mean speed towards the waypoint, of the last iteration"
)
STUCK = Metric("t6gps_stuck_ratio", _GAUGE, "share of time stuck by distance, of the last iteration")

METRICS = tuple(value for value in globals().values() if isinstance(value, Metric))
"""All of them, in the order of the page."""
