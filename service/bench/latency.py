"""How fast the pool reacts: new weights in the hands of workers, a killed or stopped worker replaced.

Real processes throughout. Faults hit workers in the midst of real episodes; weights go to stub workers, whose episodes
are short.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from t6gps.service import seeding
from t6gps.service.bench.contenders import Enough, Job, opened
from t6gps.service.pool.state import Worker, WorkerPhase
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.stub import StubWorker

STUB_EPISODE_S = 0.05
BETWEEN_FAULTS = (3, 7)
"""Fewest episodes from a recovery to the next fault, and more than the most."""


class _Stamping(StubWorker):
    """Writes down when it first runs each version of the policy, in a file VERSION-PID of `folder`."""

    def __init__(self, settings: object, folder: Path) -> None:
        super().__init__(settings, episode_s=STUB_EPISODE_S)
        self._folder, self._version = folder, -1

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        if snapshot.version != self._version:
            self._version = snapshot.version
            (self._folder / f"{snapshot.version}-{os.getpid()}").write_text(repr(time.monotonic()))
        return super().run(plan, snapshot)


def weight_latencies(job: Job, versions_n: int) -> list[float]:
    """Seconds from a new policy of the learner to each worker that begins to act with it, for some versions.

    Workers idle before, as they do when an iteration begins.
    """
    episodes_n = 4 * job.workers
    config = job.config.model_copy(update={"run": job.config.run.model_copy(update={"episodes": episodes_n})})
    latencies = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with opened(config, make_worker=partial(_Stamping, folder=folder)) as (executor, _):
            for version in range(versions_n):
                plans = seeding.training_plans(config, version)
                begin_s = time.monotonic()
                executor.sample(plans, replace(job.snapshot, version=version), lambda _: None)
                stamps = [float(path.read_text()) for path in folder.glob(f"{version}-*")]
                latencies += [stamp - begin_s for stamp in stamps]
    return latencies


def recoveries(job: Job, faults: dict[signal.Signals, int]) -> dict[signal.Signals, list[float]]:
    """Seconds from a signal to a worker in mid-episode to the first accepted episode of its successor, by signal.

    Each signal is sent as often as `faults` says, to a worker drawn at random, a few episodes after the last recovery.
    """
    rng = np.random.default_rng(0)
    due = [number for number, times in faults.items() for _ in range(times)]
    took_s: dict[signal.Signals, list[float]] = {number: [] for number in faults}
    hit: Worker | None = None
    hit_s, calm_n = 0.0, job.workers  # once all have sent an episode, the deadlines are measured
    with opened(job.config) as (executor, spool):

        def keep(episode: Episode) -> None:
            nonlocal hit, hit_s, calm_n
            lease = executor.ledger.lease_of(episode.episode_id)
            if hit and lease and lease.slot == hit.id.slot and lease.incarnation > hit.id.incarnation:
                took_s[due.pop(0)].append(time.monotonic() - hit_s)
                hit, calm_n = None, int(rng.integers(*BETWEEN_FAULTS))
            spool.append(episode)
            calm_n -= 1
            if not due:
                raise Enough
            workers = executor.pool.state.workers.values()
            at_work = [worker for worker in workers if worker.phase is WorkerPhase.SAMPLING]
            if hit is None and calm_n <= 0 and at_work:
                hit, hit_s = at_work[rng.integers(len(at_work))], time.monotonic()
                assert hit.identity is not None  # it is at work
                os.kill(hit.identity.pid, due[0])

        with suppress(Enough):
            executor.sample(job.plans, job.snapshot, keep)
    if due:
        raise RunError(f"the episodes ended before {len(due)} workers had recovered; measure for longer")
    return took_s
