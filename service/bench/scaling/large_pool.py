"""A simulated large pool: what supervisor, ledger and committer cost per episode with 10, 100, 1000 workers.

Supervisor, ledger, spool and Ray's object store are the real ones, and so are the tables' sizes. A worker is only a
slot in one of a few actor processes, which sleeps and then sends an episode of random numbers: a thousand processes
with an interpreter each would need some 80 GB.
"""

from __future__ import annotations

import asyncio
import os
import socket
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import ray

from t6gps.service import seeding
from t6gps.service.bench.contenders import Enough, Job
from t6gps.service.bench.role_clock import RoleClock, ThreadClock
from t6gps.service.bench.tally import Tally, steps_of
from t6gps.service.config import Config
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.outside import Nobody
from t6gps.service.pool.pool import Pool
from t6gps.service.pool.state import Identity, PoolState, RunState, WorkerId
from t6gps.service.pool.transport import Report
from t6gps.service.ray_backend.cluster import connection, this_node
from t6gps.service.ray_backend.transport import Call, RayTransport, Remote
from t6gps.service.ray_backend.worker_actor import Answer, Started
from t6gps.storage import ipc
from t6gps.storage.records import Episode, EpisodePlan
from t6gps.storage.spool import Spool
from t6gps.workers import stub

PROCESSES_N, CPUS_PER_PROCESS = 4, 0.25
EPISODE_S = 1.0
NOTE = (
    f"pool_N_*: N simulated workers are slots of {PROCESSES_N} real Ray actors with {CPUS_PER_PROCESS} CPUs each; "
    f"a slot sleeps {EPISODE_S:g} s per episode, nothing is simulated, pulled or checked in it; "
    "supervisor, ledger, committer and Ray's object store are real"
)


class SlotsActor:
    """Many workers in one process, each a call that sleeps."""

    def __init__(self, job: Job) -> None:
        self._whole = stub.episode(job.plans[0], job.snapshot)
        self._turns: dict[int, asyncio.Lock] = {}

    async def open(self, slot: int) -> Started:
        """Make a slot; as WorkerActor.open, but with no process to end with it."""
        self._turns[slot] = asyncio.Lock()
        return Started(Identity(os.getpid(), socket.gethostname(), this_node(), ""), None)

    async def ping(self) -> None:
        """A sign of life."""

    async def run(self, slot: int, plan: EpisodePlan) -> Answer:
        """Sleep, when the slot's last plan is done; then send the same numbers under the plan's number."""
        async with self._turns[slot]:
            await asyncio.sleep(EPISODE_S)
        return Answer(ipc.pack(*(_renumbered(table, plan) for table in (self._whole.frames, self._whole.summary))))


def _renumbered(table: pa.Table, plan: EpisodePlan) -> pa.Table:
    column = table.schema.get_field_index("episode_id")
    field = table.schema.field(column)
    return table.set_column(column, field, pa.array(np.full(table.num_rows, plan.episode_id), field.type))


class SlotsTransport(RayTransport):
    """Workers as slots of a few actors.

    calls   counts what plans and results take of the supervisor's thread
    """

    def __init__(self, job: Job, slots_n: int) -> None:
        super().__init__(_no_worker, job.config.rollout, CPUS_PER_PROCESS, TIMINGS)
        plain: Any = SlotsActor
        made = ray.remote(num_cpus=CPUS_PER_PROCESS, max_restarts=0)(plain).options(max_concurrency=4 * slots_n)
        self._actors = [made.remote(job) for _ in range(PROCESSES_N)]
        self.calls = ThreadClock()

    def start(self, worker: WorkerId) -> None:
        actor = self._actors[worker.slot % PROCESSES_N]
        self._begin(worker, Remote(actor), actor.open.remote(worker.slot))

    def send(self, worker: WorkerId, plan: EpisodePlan) -> None:
        with self.calls:
            self._await(Call(worker, self._remotes[worker].actor.run.remote(worker.slot, plan), plan))

    def poll(self, wait_s: float) -> list[Report]:
        with self.calls:
            return super().poll(wait_s)

    def close(self) -> None:
        """End the actors."""
        for actor in self._actors:
            ray.kill(actor)


def _no_worker(_: object) -> Any:
    raise NotImplementedError("slots make no worker")


class _TimedLedger(Ledger):
    """Counts what is spent in it per episode's way: lease, arrive, commit."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = ThreadClock()

    def lease(self, slot: int, incarnation: int) -> EpisodePlan | None:
        with self.clock:
            return super().lease(slot, incarnation)

    def arrive(self, plan: EpisodePlan) -> bool:
        with self.clock:
            return super().arrive(plan)

    def commit(self, episode_id: int) -> None:
        with self.clock:
            super().commit(episode_id)


def large_pool(job: Job, sizes: tuple[int, ...], seconds: float) -> dict[str, float]:
    """By number of workers n, over `seconds` of each (keys start with pool_n_).

    asked_episodes_per_s, episodes_per_s     n / EPISODE_S, and what was committed
    supervisor_ms, ledger_ms, committer_ms   processor time of the main thread per committed episode; the supervisor's
                                             has Ray's calls from it
    calls_ms                                 of the supervisor's, Ray's calls and what they give back
    background_ms                            processor time of Ray's threads in the same process
    commit_wait_ms                           what the main thread waits while it commits an episode: for the disk, and
                                             for a core where the machine has other work
    most_episodes_per_s                      where the main thread has no time left: the sum of the above but for the
                                             background is a second
    """
    with connection(job.config):
        return {f"pool_{n}_{key}": value for n in sizes for key, value in _measured(job, n, seconds).items()}


def _measured(job: Job, workers_n: int, seconds: float) -> dict[str, float]:
    plans = seeding.training_plans(_with_episodes(job.config, round(3 * workers_n * (seconds / EPISODE_S + 2))), 0)
    ledger, clock, tally = _TimedLedger(), RoleClock(), Tally(seconds)
    transport = SlotsTransport(job, workers_n)
    state = PoolState(workers_n, "", ledger, TIMINGS, EpisodeTimes(TIMINGS.shortest_episode_s))
    pool = Pool(state, transport, Nobody(), lambda _: None)
    with tempfile.TemporaryDirectory() as folder:
        spool = Spool(Path(folder), 0)
        while state.condition is not RunState.RUNNING:
            pool.tick(0.1)
        pool.open(plans, [], {})
        wait_s = main_s = 0.0

        def keep(episode: Episode) -> None:
            nonlocal wait_s, main_s
            begin_s, busy_s = time.monotonic(), time.thread_time()
            with clock.of("committer"):
                spool.append(episode)
            wait_s += time.monotonic() - begin_s - (time.thread_time() - busy_s)
            if tally.add(steps_of(episode)):
                raise Enough
            if len(tally.done) == 1:  # from here on it is counted
                clock.start()
                ledger.clock.spent_s, transport.calls.spent_s = 0.0, 0.0
                wait_s, main_s = 0.0, time.thread_time()

        with suppress(Enough):
            pool.sample(keep)
        main_s = time.thread_time() - main_s
        spent_s = clock.spent_s()
    transport.close()
    episodes_n = len(tally.done) - 1
    took_s = tally.done[-1][0] - tally.done[0][0]
    own_s = spent_s["supervisor"] + spent_s["committer"]
    return {
        "asked_episodes_per_s": workers_n / EPISODE_S,
        "episodes_per_s": episodes_n / took_s,
        "supervisor_ms": 1e3 * (main_s - ledger.clock.spent_s - spent_s["committer"]) / episodes_n,
        "calls_ms": 1e3 * transport.calls.spent_s / episodes_n,
        "ledger_ms": 1e3 * ledger.clock.spent_s / episodes_n,
        "committer_ms": 1e3 * spent_s["committer"] / episodes_n,
        "background_ms": 1e3 * (own_s - main_s) / episodes_n,
        "commit_wait_ms": 1e3 * wait_s / episodes_n,
        "most_episodes_per_s": episodes_n / (main_s + wait_s),
    }


def _with_episodes(config: Config, episodes: int) -> Config:
    return config.model_copy(update={"run": config.run.model_copy(update={"episodes": episodes})})
