"""Laws of a run on several nodes: three of Ray's on this machine, workers that obey orders, and a node that dies.

Nodes join and go in the order of the tests; each leaves the run with three workers, ready.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import ray
from house import QUICK, House, add_node, others, pid, three_nodes
from ray.cluster_utils import Cluster

from t6gps.service.pool.state import Worker
from t6gps.service.ray_backend import cluster
from t6gps.service.steering import requests
from t6gps.storage import catalog
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode

CPUS_PER_WORKER = 0.6
CONFIG = {"run": {"episodes": 45, "steps": 250, "workers": 3, "cpus_per_worker": CPUS_PER_WORKER}}


@pytest.fixture(scope="module")
def nodes() -> Iterator[Cluster]:
    with three_nodes() as cluster_of_three:
        yield cluster_of_three


@pytest.fixture(scope="module")
def everything(nodes: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    house = House(tmp_path_factory.mktemp("nodes"), CONFIG, replace(QUICK, examine_s=10.0))  # a busy machine
    with catalog.locked(house.run):
        try:
            yield house
        finally:
            house.executor.close()


@pytest.fixture
def house(everything: House, wait_until: Callable[..., None]) -> House:
    """Three workers, ready."""
    wait_until(lambda: everything.ready(3), 300)
    return everything


def node_of(worker: Worker) -> str:
    """The node of a worker that is ready, in Ray's words."""
    assert worker.identity is not None
    name: str = worker.identity.node_id
    return name


def nodes_in_use(house: House) -> set[str]:
    return {node_of(worker) for worker in house.workers}


def busy(house: House, names: Container[str]) -> Worker | None:
    """A worker with two plans on one of these nodes."""
    return next((worker for worker in house.workers if len(worker.plans) == 2 and node_of(worker) in names), None)


def test_workers_are_spread_over_all_nodes_and_give_the_same_data(house: House) -> None:
    assert nodes_in_use(house) == {node["NodeID"] for node in ray.nodes()}
    house.check(house.sample())
    assert cluster.free_workers(CPUS_PER_WORKER) == 0  # 0.4 CPUs are left on each, and no worker fits on any
    assert ray.available_resources()["CPU"] > CPUS_PER_WORKER


@pytest.mark.parametrize("how", ["SIGSTOP", "hang-in-c"])
def test_t2_a_worker_that_hangs_on_another_node_is_looked_into_and_ended_there(
    house: House, nodes: Cluster, wait_until: Callable[..., None], how: str
) -> None:
    house.check(house.sample())  # the deadlines are measured now
    process, struck = 0, -1  # and the episode that hangs

    def strike(sampled: list[Episode]) -> None:
        nonlocal process, struck
        victim = busy(house, others(nodes))
        came = [episode.episode_id for episode in sampled]
        missed = how == "hang-in-c" and struck in came and not house.executor.ledger.failures  # it had begun already
        if victim is not None and (struck < 0 or missed):
            process, struck = pid(victim), victim.plans[1].episode_id
            if how == "SIGSTOP":
                os.kill(process, signal.SIGSTOP)
            else:
                (house.orders / f"episode-{struck}").write_text("hang-in-c 1")

    house.check(house.sample(strike))
    ((failure,),) = house.executor.ledger.failures.values()
    assert {"SIGSTOP": "(SIGSTOP)", "hang-in-c": "_hang_in_c"}[how] in failure.trace
    assert failure.kind == {"SIGSTOP": "lost", "hang-in-c": "hang"}[how]
    wait_until(lambda: not Path(f"/proc/{process}").exists(), 240)


def test_a_node_that_joins_gets_workers_when_more_are_asked_for(house: House, nodes: Cluster) -> None:
    answers: list[Any] = []

    def scale() -> None:
        try:
            answers.append(requests.scale(house.run, 4, 300)["ready"])
        except RunError as error:  # told by the main thread
            answers.append(error)

    scaling, before, joined = threading.Thread(target=scale), nodes_in_use(house), False
    scaling.start()
    while scaling.is_alive():
        house.check(house.sample())
        if not joined and "wait for a CPU" in house.executor.pool.state.reason:
            add_node(nodes)
            joined = True
    assert answers == [4]
    assert len(nodes_in_use(house)) == len(before) + 1
    house.check(house.sample())
    house.executor.pool.state.wanted = 3


def test_t16_a_node_that_dies_takes_no_episode_with_it(
    house: House, nodes: Cluster, wait_until: Callable[..., None]
) -> None:
    add_node(nodes)  # there is room for a successor
    failures_n, slot, incarnation, node = house.executor.ledger.counters["failures"], 0, 0, ""

    def remove(_: list[Episode]) -> None:
        nonlocal slot, incarnation, node
        victim = busy(house, others(nodes))
        if victim is not None and not node:
            slot, incarnation, node = *victim.id, node_of(victim)
            nodes.remove_node(others(nodes)[node], allow_graceful=False)

    house.check(house.sample(remove))
    assert house.executor.ledger.counters["failures"] == failures_n  # no episode is to blame
    wait_until(lambda: house.ready(3) and node not in nodes_in_use(house), 300)
    assert house.executor.pool.state.workers[slot].id.incarnation > incarnation
    house.check(house.sample())
