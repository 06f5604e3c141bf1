"""What the supervisor knows: its workers, their slots, the ledger, and how the pool is.

Everything is plain data, so that a state can be written down and read again (`decision_log`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

from t6gps.service.pool.deadlines import EpisodeTimes, Timings
from t6gps.service.pool.ledger import Ledger
from t6gps.storage.records import EpisodePlan

FIRST_BACK_OFF_S = 0.5
LONGEST_BACK_OFF_S = 30.0


class WorkerPhase(StrEnum):
    """What a worker does."""

    STARTING = "starting"
    """Its process starts, or waits for a CPU."""
    IDLE = "idle"
    """It waits for a plan."""
    SAMPLING = "sampling"
    """It runs an episode."""
    DRAINING = "draining"
    """It finishes its episode and gets no other."""
    ENDING = "ending"
    """Its process is being looked at and ended."""


NEXT_PHASES = {
    WorkerPhase.STARTING: {WorkerPhase.IDLE, WorkerPhase.ENDING},
    WorkerPhase.IDLE: {WorkerPhase.SAMPLING, WorkerPhase.ENDING},
    WorkerPhase.SAMPLING: {WorkerPhase.IDLE, WorkerPhase.DRAINING, WorkerPhase.ENDING},
    WorkerPhase.DRAINING: {WorkerPhase.IDLE, WorkerPhase.SAMPLING, WorkerPhase.ENDING},
    WorkerPhase.ENDING: set[WorkerPhase](),
}
"""The phases that may follow each."""


class Ending(StrEnum):
    """Why a worker ends; the values are the names of the counters."""

    CRASH = "crashed"
    """Its process ended by itself."""
    HANG = "hung"
    """A deadline passed."""
    DRAINED = "drained"
    """It was not needed any more."""


class RunState(StrEnum):
    """How a run is."""

    RUNNING = "RUNNING"
    """As many workers as asked for are ready."""
    DEGRADED = "DEGRADED"
    """Fewer; the reason says why."""
    PAUSED = "PAUSED"
    """Scaled to none."""
    STOPPING = "STOPPING"
    """Being stopped."""
    STOPPED = "STOPPED"
    """Its process has ended and the run is not done; `--resume` continues it."""
    DONE = "DONE"
    """All iterations and the evaluation are kept."""
    FAILED = "FAILED"
    """The reason says why."""


_ALIVE = {RunState.RUNNING, RunState.DEGRADED, RunState.PAUSED}
_LAST = {RunState.STOPPING, RunState.DONE, RunState.FAILED}
NEXT_STATES = {
    RunState.RUNNING: {RunState.DEGRADED, RunState.PAUSED} | _LAST,
    RunState.DEGRADED: {RunState.RUNNING, RunState.PAUSED} | _LAST,
    RunState.PAUSED: {RunState.RUNNING, RunState.DEGRADED} | _LAST,
    RunState.STOPPING: {RunState.STOPPED},
    RunState.STOPPED: _ALIVE - {RunState.RUNNING, RunState.PAUSED},
    RunState.DONE: set[RunState](),
    RunState.FAILED: {RunState.DEGRADED},
}
"""The states that may follow each; a stopped or failed run that is resumed begins as DEGRADED."""


class WorkerId(NamedTuple):
    """A worker: the slot that it fills, and how many have filled it with this one."""

    slot: int
    incarnation: int

    def __str__(self) -> str:
        return f"slot {self.slot}, incarnation {self.incarnation}"


@dataclass(frozen=True)
class Identity:
    """Who a worker is, as it says itself when it is ready.

    node      the address of its machine
    node_id   the cluster's name for it
    build     what its data depend on beside the settings: versions and digests by name (`provenance.build`)
    """

    pid: int
    node: str
    node_id: str
    settings_digest: str
    build: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Worker:
    """A worker as the supervisor sees it.

    since_s      when its phase began, or the episode in hand
    plans        its leases in their order: it is at work on the first
    placed       its process has found a CPU
    pinged_s     when it was last asked for a sign of life; `answered` when it gave one
    deadline_s   when the episode in hand is overdue
    ending       why it is being ended, with the error and its message
    """

    id: WorkerId
    since_s: float
    phase: WorkerPhase = WorkerPhase.STARTING
    identity: Identity | None = None
    plans: deque[EpisodePlan] = field(default_factory=deque)
    placed: bool = True
    pinged_s: float | None = None
    answered: bool = True
    deadline_s: float | None = None
    ending: tuple[Ending, str, str] | None = None

    def enter(self, phase: WorkerPhase) -> None:
        """Come to another phase; the same is no change."""
        if phase is not self.phase:
            assert phase in NEXT_PHASES[self.phase], f"worker {self.id} cannot go from {self.phase} to {phase}"
            self.phase = phase

    @property
    def ready(self) -> bool:
        """It takes plans."""
        return self.phase in (WorkerPhase.IDLE, WorkerPhase.SAMPLING)


@dataclass
class Slot:
    """What is remembered of a slot from one incarnation to the next."""

    incarnations_n: int = 0
    failures_n: int = 0
    retry_s: float | None = None
    """No worker is started here before."""
    trouble: str = ""
    """Why the last worker here failed, in words; empty when it was not needed any more."""

    def failed(self, now: float, trouble: str) -> None:
        """A worker has failed here: the first time costs nothing, then each wait is twice as long as the last."""
        self.failures_n, self.trouble = self.failures_n + 1, trouble
        if self.failures_n > 1:
            self.retry_s = now + min(FIRST_BACK_OFF_S * 2 ** (self.failures_n - 2), LONGEST_BACK_OFF_S)


@dataclass
class PoolState:
    """Everything that a decision of the supervisor depends on, beside what it observes and the time.

    wanted             workers that the run shall have; `autoscale` (least, most) moves it
    before_pause       the two of them before the run was scaled to none
    settings_digest    every worker must have the settings that this stands for
    build              what every worker's installation must be (`Identity`)
    policy_digests     the policies that the plans of the batch name, by version
    largest_bytes      of an episode so far: episodes under way count with it
    failed_starts_n    starts in a row that failed
    last_trouble       the newest failure, in words
    free_n, asked_s    room for more workers, and when the cluster was asked
    asked_n            workers that the cluster was last asked to have room for
    needed_s           when autoscaling last needed as many workers as there are
    judges_from_s      when deadlines count again
    """

    wanted: int
    settings_digest: str
    ledger: Ledger
    timings: Timings
    times: EpisodeTimes
    autoscale: tuple[int, int] | None = None
    before_pause: tuple[int, tuple[int, int] | None] | None = None
    build: dict[str, str] = field(default_factory=dict)
    condition: RunState = RunState.DEGRADED
    reason: str = "the workers are starting"
    workers: dict[int, Worker] = field(default_factory=dict)
    slots: dict[int, Slot] = field(default_factory=dict)
    policy_digests: dict[int, str] = field(default_factory=dict)
    largest_bytes: int = 1
    bytes_in_flight: int = 2**30
    failed_starts_n: int = 0
    last_trouble: str = ""
    free_n: int = 0
    asked_s: float | None = None
    asked_n: int = 0
    needed_s: float | None = None
    judges_from_s: float | None = None
    counters: dict[str, int] = field(
        default_factory=lambda: {"started": 0, Ending.CRASH: 0, Ending.HANG: 0, Ending.DRAINED: 0}
    )

    def worker(self, worker: WorkerId) -> Worker | None:
        """A worker, None when it has ended or is about to."""
        known = self.workers.get(worker.slot)
        return known if known and known.id == worker and known.phase is not WorkerPhase.ENDING else None

    def turn(self, condition: RunState, reason: str) -> None:
        """Come to another condition."""
        if condition is not self.condition:
            assert condition in NEXT_STATES[self.condition], f"a run cannot go from {self.condition} to {condition}"
            self.condition = condition
        self.reason = reason
