"""An executor with stub workers that obey orders, and the policy and plans of one batch after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.pool.deadlines import Timings
from t6gps.service.pool.state import RunState, Worker
from t6gps.service.ray_backend import cluster, private
from t6gps.storage import catalog, schema
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers import stub
from t6gps.workers.stub import StubWorker

EPISODE_S, RUN = 0.1, "faults"
QUICK = Timings(shortest_episode_s=3.0, policy_answer_s=1.5)
"""Hangs are found after 3 s: the episodes take a tenth of a second."""
CONFIG = {"run": {"episodes": 30, "steps": 20, "workers": 2, "cpus_per_worker": 0.5}}

QUICK_HEALTH_CHECKS = {
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "5000",
    "RAY_health_check_failure_threshold": "3",
}
"""For a cluster's head: a node that dies is noticed within three seconds, one that is cut off or busy within twenty."""

START_ATTEMPTS_N = 4
NODE = {"include_dashboard": False, "node_ip_address": "127.0.0.1"}


def add_node(nodes: Cluster, cpus: int = 1) -> None:
    """Add a node, the head first. Ray gives it half a minute to start, which is short on a busy machine."""
    for attempt in range(START_ATTEMPTS_N):
        try:
            nodes.add_node(num_cpus=cpus, **NODE)
            return
        except Exception as error:  # Ray has no narrower one
            if "timed out during startup" not in str(error) or attempt == START_ATTEMPTS_N - 1:
                raise


@contextmanager
def joining(environment: Mapping[str, str]) -> Iterator[None]:
    """Executors that start meanwhile join the Ray that these variables lead to."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


@contextmanager
def started(cpus_of_nodes: Sequence[int], **settings: str) -> Iterator[tuple[Cluster, dict[str, str]]]:
    """A Ray on the loopback address with a node for each entry, and the variables that lead to it."""
    environment = cluster.embedded_environment() | settings
    with private.adapted(), joining(environment):
        private.read_authentication()
        nodes = Cluster()
        for cpus in cpus_of_nodes:
            add_node(nodes, cpus)
    try:
        yield nodes, environment | {"RAY_ADDRESS": nodes.address}
    finally:
        nodes.shutdown()


@contextmanager
def three_nodes() -> Iterator[Cluster]:
    """A cluster of three nodes of one CPU on this machine, which executors join meanwhile."""
    with started([1, 1, 1], **QUICK_HEALTH_CHECKS) as (nodes, environment), joining(environment):
        try:
            yield nodes
        finally:
            ray.shutdown()


def others(nodes: Cluster) -> dict[str, Any]:
    """Nodes that the run can do without, by their names: neither the head nor the supervisor's."""
    return {node.node_id: node for node in nodes.worker_nodes if node.node_id != cluster.this_node()}


class House:
    """An executor with stub workers, its orders, and one batch after another."""

    def __init__(self, root: Path, config: dict[str, Any] | None = None, timings: Timings = QUICK) -> None:
        self.config = Config.model_validate(config or CONFIG)
        self.run = catalog.create(root, RUN, self.config.to_json())
        self.orders = root / "orders"
        self.orders.mkdir()
        make = partial(StubWorker, episode_s=EPISODE_S, orders=self.orders)
        self.executor = RayExecutor(self.config, self.run, make, timings)
        self.iteration = -1

    def order(self, episode: int, what: str) -> int:
        """Order a fault for an episode of the next batch."""
        number = (self.iteration + 1) * self.config.run.episodes + episode
        (self.orders / f"episode-{number}").write_text(what)
        return number

    def sample(self, after_each: Callable[[list[Episode]], None] = lambda _: None) -> list[Episode]:
        """A new batch, with a policy of its own; `after_each` sees the episodes that there are so far."""
        self.iteration += 1
        return self.sample_again(self.plans, after_each)

    def sample_again(
        self, plans: list[EpisodePlan], after_each: Callable[[list[Episode]], None] = lambda _: None
    ) -> list[Episode]:
        """Plans of the same batch."""
        sampled: list[Episode] = []

        def keep(episode: Episode) -> None:
            sampled.append(episode)
            after_each(sampled)

        self.executor.sample(plans, policy(self.iteration), keep)
        return sampled

    @property
    def plans(self) -> list[EpisodePlan]:
        return seeding.training_plans(self.config, self.iteration)

    @property
    def workers(self) -> list[Worker]:
        return list(self.executor.pool.state.workers.values())

    def ready(self, n: int) -> bool:
        """Tick; True when there are n workers and all are ready."""
        pool = self.executor.pool
        pool.tick(0.02)
        return len(self.workers) == n and pool.state.condition is RunState.RUNNING

    def check(self, sampled: list[Episode], without: tuple[int, ...] = ()) -> None:
        """Every planned episode is there once, and it is what the plan alone makes of it."""
        numbers = [episode.episode_id for episode in sampled]
        expected = {plan.episode_id: plan for plan in self.plans if plan.episode_id not in without}
        assert sorted(numbers) == sorted(expected)
        for number, episode in zip(numbers, sampled, strict=True):
            alone = stub.episode(expected[number], policy(self.iteration))
            assert episode.frames.equals(alone.frames)
            assert episode.summary.equals(alone.summary)


def policy(version: int) -> PolicySnapshot:
    rng = np.random.default_rng(version)
    widths = [schema.OBSERVATION_N, 8, 24]
    layers = tuple(
        (rng.standard_normal((b, a)).astype(np.float32), np.zeros(b, np.float32)) for a, b in pairwise(widths)
    )
    return PolicySnapshot(version, layers, 1.0, 0.2)


def pid(worker: Worker) -> int:
    """The process of a worker that is ready."""
    assert worker.identity is not None
    return worker.identity.pid
