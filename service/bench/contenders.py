"""The same episodes in several ways: a plain loop, the service, and processes joined by pipes.

Each takes a job and gives a tally.

    raw       every process runs the next episode of the plan and forgets it: no Ray, nothing sent, nothing kept
    service   what `t6gps train` does while it samples: pool, ledger, spool forced to disk, learner at work on what came
    pipes     a process gets a plan through a pipe and sends the checked episode back; the parent forces it to the spool
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench.role_clock import RoleClock
from t6gps.service.bench.tally import NotingWorker, Tally, steps_of
from t6gps.service.config import Config
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.wiring import new_learner
from t6gps.service.pool.attempt import Failure, attempt
from t6gps.service.pool.pool import TICK_S
from t6gps.service.pool.state import RunState
from t6gps.storage import catalog
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.storage.spool import Spool
from t6gps.workers.settings import RolloutSettings

START_DEADLINE_S = 180.0
PRESET = "rough"
MOST_EPISODES_PER_S = 20
"""More than a process simulates of the preset's episodes."""


class Enough(Exception):
    """Ends a call of `Executor.sample` early."""


@dataclass(frozen=True)
class Job:
    """Episodes to run one after the other, by `config.run.workers` processes, for `seconds` after the first is done."""

    config: Config
    plans: list[EpisodePlan]
    snapshot: PolicySnapshot
    seconds: float

    @property
    def workers(self) -> int:
        """Processes that simulate."""
        return self.config.run.workers

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return self.config.run.steps


def rough_job(workers: int, seconds: float) -> Job:
    """Episodes of PRESET with the untrained policy, more than any contender runs in that time."""
    episodes = round(MOST_EPISODES_PER_S * workers * (seconds + 10))
    config = configuration.load(PRESET, [f"run.workers={workers}", f"run.episodes={episodes}"])
    return Job(config, seeding.training_plans(config, 0), new_learner(config).policy(), seconds)


def raw(job: Job) -> Tally:
    """A plain loop in each of N processes, which share nothing but the number of the next plan."""
    context = multiprocessing.get_context("spawn")
    number, barrier = context.Value("i", 0), context.Barrier(job.workers)
    with (
        tempfile.TemporaryDirectory() as notes,
        _processes(job.workers, _loop, job, Path(notes), number, barrier) as connections,
    ):
        tallies: list[Tally] = [_received(connection) for connection in connections]
    end_s = min(tally.done[-1][0] for tally in tallies)  # later on, fewer processes were at work
    merged = Tally(job.seconds)
    merged.done = sorted(entry for tally in tallies for entry in tally.done if entry[0] <= end_s)
    merged.simulating = sum(tally.simulating for tally in tallies)
    return merged


def _loop(connection: Connection, job: Job, notes: Path, number: Synchronized[int], barrier: Barrier) -> None:
    tally = Tally(job.seconds)
    with closing(NotingWorker(job.config.rollout, notes)) as worker:
        barrier.wait(START_DEADLINE_S)
        while not tally.is_over:
            with number.get_lock():
                plan = job.plans[number.value]
                number.value += 1
            tally.add(steps_of(worker.run(plan, job.snapshot)))
    tally.read([notes / str(os.getpid())])
    connection.send(tally)


def pipes(job: Job) -> Tally:
    """One plan under way per process; the next one goes out before an episode is written."""
    tally, plans = Tally(job.seconds), iter(job.plans)
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryDirectory() as notes,
        _processes(job.workers, _serve, job.config.rollout, job.snapshot, Path(notes)) as connections,
    ):
        spool = Spool(Path(folder), 0)
        for connection in connections:
            _received(connection)
        for connection in connections:
            connection.send(next(plans))
        while not tally.is_over:
            ready = wait(connections)
            for connection in [connection for connection in connections if connection in ready]:
                episode = _received(connection)
                connection.send(next(plans))
                if not isinstance(episode, Failure):
                    spool.append(episode)
                    tally.add(steps_of(episode))
        tally.read(Path(notes).iterdir())
    return tally


def _serve(connection: Connection, settings: RolloutSettings, snapshot: PolicySnapshot, notes: Path) -> None:
    worker = NotingWorker(settings, notes)
    connection.send("ready")
    while True:
        connection.send(attempt(worker, connection.recv(), snapshot))


@contextmanager
def _processes(n: int, target: Callable[..., None], *arguments: object) -> Iterator[list[Connection]]:
    """N fresh processes, each called with its end of a pipe and the arguments; they are killed at the end."""
    context = multiprocessing.get_context("spawn")
    pairs = [context.Pipe() for _ in range(n)]
    started = []
    try:
        for _, remote_end in pairs:
            process = context.Process(target=target, args=(remote_end, *arguments), daemon=True)
            process.start()
            started.append(process)
            remote_end.close()
        yield [local_end for local_end, _ in pairs]
    finally:
        for process in started:
            process.kill()
            process.join()
        for local_end, _ in pairs:
            local_end.close()


def _received(connection: Connection) -> Any:
    try:
        return connection.recv()
    except EOFError:
        raise RunError("a process of the benchmark died; see its message above, and try again") from None


def service(job: Job) -> Tally:
    """The tally of committed steps, with the processor time of each role meanwhile."""
    tally, clock = Tally(job.seconds), RoleClock()
    with (
        tempfile.TemporaryDirectory() as notes,
        opened(job.config, make_worker=partial(NotingWorker, folder=Path(notes))) as (executor, spool),
    ):

        def keep(episode: Episode) -> None:
            with clock.of("committer"):
                spool.append(episode)
            if tally.add(steps_of(episode)):
                raise Enough
            executor.feed(episode)
            if len(tally.done) == 1:
                clock.start()

        with suppress(Enough):
            executor.sample(job.plans, job.snapshot, keep)
        tally.spent_s = clock.spent_s()
        tally.read(Path(notes).iterdir())
    return tally


@contextmanager
def opened(config: Config, **options: Any) -> Iterator[tuple[RayExecutor, Spool]]:
    """The service with all its workers and its learner ready, and the spool of a run that is thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        run = catalog.create(Path(folder), "bench", config.to_json())
        with closing(RayExecutor(config, run, **options)) as executor:
            executor.learner.policy()  # it is ready
            deadline_s = time.monotonic() + START_DEADLINE_S
            while executor.pool.state.condition is not RunState.RUNNING:
                if time.monotonic() > deadline_s:
                    raise RunError(
                        f"the workers did not start within {START_DEADLINE_S:.0f} s: {executor.pool.state.reason}"
                    )
                executor.pool.tick(TICK_S)
            yield executor, Spool(run.spool, 0)
            executor.close(RunState.DONE)
