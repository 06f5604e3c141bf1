"""Soak: workers are killed, stopped and scaled at random for minutes; nothing is lost, and nothing grows.

T6GPS_SOAK_MINUTES says how long, one minute by default; `make soak` takes thirty and prints the figures.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import ray
from house import joining

from t6gps.learner import policy
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.pool.deadlines import Timings
from t6gps.service.pool.state import RunState, Worker, WorkerPhase
from t6gps.storage import catalog, durable, schema
from t6gps.storage.records import Episode, EpisodePlan
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.stub import StubWorker

MINUTES = float(os.environ.get("T6GPS_SOAK_MINUTES", "1"))
CONFIG = {"run": {"episodes": 100, "steps": 250, "workers": 2, "cpus_per_worker": 0.5}}
EPISODE_S, FAULT_EVERY_S, SAMPLE_EVERY_S = 0.1, 4.0, 1.0
FAULTS = ("kill", "stop", "scale")
LEAST_FAULTS_N = 3
"""A soak lasts until so many workers were killed or stopped: on a busy machine they take longer to recover."""
WARM_UP = 0.4
"""Share of the time that is not measured: the first grown and killed workers fill pools and caches."""
STEEPEST_MB_PER_MIN, CACHES_MB = 1.0, 2.0
"""What a process may grow by, and what it may in a soak too short to tell: 2% of the episodes are more."""


class Soak:
    """An executor with stub workers, the faults done to it, and what was measured meanwhile."""

    def __init__(self, root: Path) -> None:
        self.config = Config.model_validate(CONFIG)
        self.run = catalog.create(root, "soak", self.config.to_json())
        make = partial(StubWorker, episode_s=EPISODE_S)
        self.executor = RayExecutor(self.config, self.run, make, Timings(shortest_episode_s=2.0))
        self.rng = np.random.default_rng(0)
        self.faults = dict.fromkeys(FAULTS, 0)
        self.measured: list[dict[str, float]] = []
        self.took_s: dict[str, list[float]] = {fault: [] for fault in FAULTS}
        self._under_way: tuple[str, int, int, float] | None = None  # fault, slot and incarnation hit, and when
        self._next_fault_s = self._next_sample_s = time.monotonic()

    @property
    def workers(self) -> dict[int, Worker]:
        return self.executor.pool.state.workers

    def episode_came(self) -> None:
        """After every episode: measure, note who is back at work, and do the next fault."""
        now = time.monotonic()
        if self._under_way is not None and self._is_over(*self._under_way[:3]):
            self.took_s[self._under_way[0]].append(now - self._under_way[3])
            self._under_way = None
        if now >= self._next_sample_s:
            self._next_sample_s = now + SAMPLE_EVERY_S
            self.measured.append(self._measure(now))
        if now >= self._next_fault_s and self._under_way is None:
            self._next_fault_s = now + FAULT_EVERY_S
            self._do(FAULTS[self.rng.integers(len(FAULTS))], now)

    def _is_over(self, fault: str, slot: int, incarnation: int) -> bool:
        """True when the successor of a killed or stopped worker, or every worker requested for, is at work."""
        at_work = [worker for worker in self.workers.values() if worker.phase is WorkerPhase.SAMPLING]
        if fault == "scale":
            return len(at_work) == len(self.workers) == self.executor.pool.state.wanted
        return any(worker.id.slot == slot and worker.id.incarnation > incarnation for worker in at_work)

    def _do(self, fault: str, now: float) -> None:
        at_work = [worker for worker in self.workers.values() if worker.phase is WorkerPhase.SAMPLING]
        if not at_work:
            return
        self.faults[fault] += 1
        if fault == "scale":
            request = {"id": str(now), "what": "workers", "workers": int(self.rng.integers(1, 4))}
            durable.replace(self.run.request, json.dumps(request).encode())
            self.executor.pool.tick()  # it has seen the request
            self._under_way = fault, -1, -1, now
            return
        victim = at_work[self.rng.integers(len(at_work))]
        assert victim.identity is not None
        self._under_way = fault, *victim.id, now
        os.kill(victim.identity.pid, signal.SIGKILL if fault == "kill" else signal.SIGSTOP)

    def _measure(self, now: float) -> dict[str, float]:
        server = self.executor.transport.policies.process
        assert server is not None
        pids = {"driver": os.getpid(), "policy_server": server.pid}
        row = {"time_min": now / 60}
        for role, pid in pids.items():
            status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
            row[f"{role}_mb"] = int(status["RssAnon"].split()[0]) / 1024
            row[f"{role}_threads"] = int(status["Threads"])
            row[f"{role}_descriptors"] = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        total, free = (numbers().get("object_store_memory", 0) for numbers in (ray.cluster_resources, _available))
        return row | {"object_store_mb": (total - free) / 2**20}

    def slope_per_min(self, name: str) -> float:
        """Slope of a straight line through what was measured after the warm-up."""
        rows = self.measured[int(len(self.measured) * WARM_UP) :]
        return float(np.polyfit([row["time_min"] for row in rows], [row[name] for row in rows], 1)[0])


def _available() -> dict[str, float]:
    return dict(ray.available_resources())


@pytest.fixture
def soak(ray_head: dict[str, str], tmp_path: Path) -> Iterator[Soak]:
    with joining(ray_head):
        soak = Soak(tmp_path)
    with catalog.locked(soak.run):
        try:
            yield soak
        finally:
            soak.executor.close()


@pytest.mark.slow
def test_t14_a_soak_loses_nothing_and_nothing_grows(soak: Soak, wait_until: Callable[..., None]) -> None:
    pool, ledger = soak.executor.pool, soak.executor.ledger
    untrained = policy.initial(schema.OBSERVATION_N, CABLES_N, [8], soak.rng, offset_m=1.0, scale_m=0.2)
    end_s, iteration, committed_n = time.monotonic() + 60 * MINUTES, 0, 0
    while time.monotonic() < end_s or soak.faults["kill"] + soak.faults["stop"] < LEAST_FAULTS_N:
        plans: list[EpisodePlan] = seeding.training_plans(soak.config, iteration)
        numbers: list[int] = []

        def keep(episode: Episode, numbers: list[int] = numbers) -> None:
            numbers.append(episode.episode_id)
            soak.episode_came()

        soak.executor.sample(plans, replace(untrained, version=iteration), keep)
        assert sorted(numbers) == [plan.episode_id for plan in plans]
        committed_n += len(numbers)
        iteration += 1

    def at_rest() -> bool:
        pool.tick(0.05)
        phases = {worker.phase for worker in soak.workers.values()}
        return pool.state.condition is RunState.RUNNING and phases == {WorkerPhase.IDLE}

    wait_until(at_rest, 240)
    figures = {name: soak.slope_per_min(name) for name in soak.measured[0] if name != "time_min"}
    kept = {"episodes": committed_n, **soak.faults, **pool.state.counters}
    waits = {f"{fault}_p95_s": np.quantile(took_s, 0.95) for fault, took_s in soak.took_s.items() if took_s}
    print(json.dumps({"minutes": MINUTES, **kept, **waits, "slopes_per_min": figures}, indent=1, default=float))
    assert ledger.counters["committed"] == committed_n
    assert ledger.counters["quarantined"] == 0
    for name in ("driver_mb", "policy_server_mb"):
        assert figures[name] * MINUTES < max(STEEPEST_MB_PER_MIN * MINUTES, CACHES_MB)
    for name in ("driver_threads", "driver_descriptors", "policy_server_threads", "policy_server_descriptors"):
        assert figures[name] * MINUTES < 10  # in the whole time; a leak of one at every fault would be more
    assert soak.measured[-1]["object_store_mb"] < 50
    assert not ledger.leases
    wait_until(lambda: _available()["CPU"] == ray.cluster_resources()["CPU"] - 0.5 * len(soak.workers), 120)
