"""A run that scales by itself on a cluster that gains and loses nodes as the run asks for them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import ray
from house import QUICK_HEALTH_CHECKS, House, add_node, joining, others, started
from ray.autoscaler._private.constants import AUTOSCALER_RESOURCE_REQUEST_CHANNEL  # Ray tells no other way
from ray.cluster_utils import Cluster
from ray.experimental.internal_kv import _internal_kv_get

from t6gps.storage import catalog
from t6gps.storage.records import Episode

# What was asked of Ray has no public reader: the test reads it where an autoscaler does.
CPUS_PER_WORKER = 0.5
CONFIG = {
    "run": {
        "episodes": 300, "steps": 5, "workers": 1, "cpus_per_worker": CPUS_PER_WORKER,
        "workers_min": 1, "workers_max": 4,
    }
}  # fmt: skip


def asked_cpus() -> float:
    """What a run has asked Ray's autoscaler for, as that reads it."""
    text = _internal_kv_get(AUTOSCALER_RESOURCE_REQUEST_CHANNEL)
    return sum(bundle["CPU"] for bundle in json.loads(text)) if text else 0.0


@pytest.fixture
def nodes() -> Iterator[Cluster]:
    """A cluster of one node with one CPU, which executors join meanwhile."""
    with started([1], **QUICK_HEALTH_CHECKS) as (nodes, environment), joining(environment):
        try:
            yield nodes
        finally:
            ray.shutdown()


@pytest.mark.slow
def test_a_cluster_grows_as_the_run_asks_and_a_node_that_is_lost_again_costs_no_episode(
    nodes: Cluster, tmp_path: Path
) -> None:
    house = House(tmp_path, CONFIG)
    with catalog.locked(house.run), closing(house.executor):
        used, lost = set[str](), list[str]()

        def lose(_: list[Episode]) -> None:
            used.update(worker.identity.node_id for worker in house.workers if worker.identity)
            if not lost and len(used) > 1:
                lost.extend(others(nodes))
                nodes.remove_node(others(nodes)[lost[0]], allow_graceful=False)

        deadline, grown = time.monotonic() + 300, False
        while not lost:
            assert time.monotonic() < deadline, house.executor.pool.state.reason
            if not grown and asked_cpus() > 1:
                add_node(nodes)
                grown = True
            house.check(house.sample(lose))
        asked = set[float]()
        house.check(house.sample(lambda _: asked.add(asked_cpus())))
        assert used >= set(lost)
        assert max(asked) == 4 * CPUS_PER_WORKER  # while plans waited; between batches it asks for what it has
        house.executor.transport.close()
        assert asked_cpus() == 0
