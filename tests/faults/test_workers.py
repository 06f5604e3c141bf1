"""Laws of the pool under faults, with real processes that obey orders: what is planned is committed once, and the same.

One executor serves the module; the workers are stubs, so that an episode takes as long as a test wants.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import ray
from house import CONFIG, House, joining, pid, policy

from t6gps.service.config import Config, parse
from t6gps.service.pool import crash_bundle
from t6gps.service.pool.attempt import policy_digest
from t6gps.service.pool.ledger import FAILURES_ALLOWED_N
from t6gps.service.pool.state import RunState, Worker
from t6gps.service.ray_backend import processes
from t6gps.service.ray_backend.policy_server import VERSIONS_HELD_N
from t6gps.service.ray_backend.processes import Process
from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.storage import catalog
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode
from t6gps.workers.stub import StubWorker

AT_LENGTH = "T6GPS_SOAK_MINUTES" in os.environ
KILLS_N, PAUSE_S = (20, 60) if AT_LENGTH else (3, 3)
"""`make soak` does what the laws say, the suite enough to see them broken."""
BATCH_S = 1.0
"""A batch takes half as long again."""


@pytest.fixture(scope="module")
def everything(ray_head: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with joining(ray_head):
        house = House(tmp_path_factory.mktemp("faults"))
    with catalog.locked(house.run):
        try:
            house.check(house.sample())  # the deadlines are measured now
            yield house
        finally:
            house.executor.close()


@pytest.fixture
def house(everything: House, wait_until: Callable[..., None]) -> House:
    """Two workers, ready."""
    wait_until(lambda: everything.ready(2), 240)
    return everything


@contextmanager
def after_every_tick(house: House, act: Callable[[float], None]) -> Iterator[None]:
    """Call `act` after every round of the supervisor, with the time that it took (s)."""
    pool = house.executor.pool
    tick = pool.tick

    def observed(wait_s: float = 0.0) -> None:
        start_s = time.monotonic()
        tick(wait_s)
        act(time.monotonic() - start_s)

    pool.tick = observed  # type: ignore[method-assign]
    try:
        yield
    finally:
        pool.tick = tick  # type: ignore[method-assign]


def at_work_on(house: House, number: int) -> list[Worker]:
    return [worker for worker in house.workers if worker.plans and worker.plans[0].episode_id == number]


def test_t1_killed_workers_lose_nothing_and_are_replaced(house: House, wait_until: Callable[..., None]) -> None:
    rng = np.random.default_rng(0)
    crashed_n, quarantined_n = house.executor.pool.state.counters["crashed"], len(house.executor.ledger.quarantined)
    for _ in range(KILLS_N):
        victim = pid(house.workers[rng.integers(2)])
        killing = threading.Timer(rng.uniform(0.0, BATCH_S), os.kill, (victim, signal.SIGKILL))
        killing.start()
        house.check(house.sample())
        killing.join()
        wait_until(lambda gone=victim: house.ready(2) and gone not in map(pid, house.workers), 240)
    assert house.executor.pool.state.counters["crashed"] == crashed_n + KILLS_N
    assert len(house.executor.ledger.quarantined) == quarantined_n


def test_an_episode_whose_workers_are_killed_from_outside_is_not_at_fault(house: House) -> None:
    number, killed = house.order(5, "slow"), list[int]()

    def kill(_: float) -> None:
        for worker in at_work_on(house, number):
            if len(killed) <= FAILURES_ALLOWED_N and pid(worker) not in killed:
                killed.append(pid(worker))
                os.kill(killed[-1], signal.SIGKILL)

    with after_every_tick(house, kill):
        house.check(house.sample())
    kinds = [failure.kind for failure in house.executor.ledger.failures[number]]
    assert kinds == ["lost"] * (FAILURES_ALLOWED_N + 1)


@pytest.mark.parametrize("how", ["SIGSTOP", "hang-in-c", "hang-in-python"])
def test_t2_a_worker_that_hangs_is_found_replaced_and_its_stacks_kept(house: House, how: str) -> None:
    number = house.order(9, "slow 1" if how == "SIGSTOP" else f"{how} 1")
    took_s, stopped = [], list[int]()

    def stop(tick_s: float) -> None:
        took_s.append(tick_s)
        if how == "SIGSTOP" and not stopped:
            for worker in at_work_on(house, number):
                stopped.append(pid(worker))
                os.kill(pid(worker), signal.SIGSTOP)

    with after_every_tick(house, stop):
        house.check(house.sample())
    (failure,) = house.executor.ledger.failures[number]
    assert failure.kind == ("lost" if how == "SIGSTOP" else "hang")  # the episode is not to blame for a stop
    assert {"SIGSTOP": "SIGSTOP", "hang-in-c": "_hang_in_c", "hang-in-python": "_hang_in_python"}[how] in failure.trace
    assert max(took_s) < 1.0


def test_t3_an_episode_that_raises_three_times_is_left_out_and_can_be_replayed(house: House) -> None:
    number = house.order(4, "raise")
    house.check(house.sample(), without=(number,))
    kept = crash_bundle.read(house.run.bundles / f"episode-{number}.json")
    assert len(kept.failures) == 3
    assert kept.failures[0]["error"] == "PhysicsError"
    assert kept.failures[0]["step"] == 10
    assert kept.failures[0]["seed"] == kept.plan.seed
    assert "_raise" in kept.failures[0]["trace"]
    assert policy_digest(kept.snapshot) == policy_digest(policy(house.iteration))
    again = crash_bundle.replay(kept, partial(StubWorker, orders=house.orders))
    assert "was ordered to fail" in str(again)
    house.iteration -= 1
    house.check(house.sample(), without=(number,))  # it is not tried again


@pytest.mark.parametrize(
    ("how", "kind", "words"),
    [("fault", "crash", "Segmentation fault"), ("exit", "lost", "was ordered to exit")],
    ids=["fault", "exit without a word"],
)
def test_a_worker_that_dies_leaves_how_it_ended_and_its_log(house: House, how: str, kind: str, words: str) -> None:
    number = house.order(6, f"{how} 1")
    house.check(house.sample())
    (failure,) = house.executor.ledger.failures[number]
    assert (failure.kind, failure.error) == (kind, "ActorDiedError")
    assert "exit" in failure.message
    assert len(failure.message) < 300
    assert words in failure.log


def test_t4_all_workers_die_at_once_and_the_run_recovers(house: House, wait_until: Callable[..., None]) -> None:
    crashed_n = house.executor.pool.state.counters["crashed"]

    def kill_all(sampled: list[Episode]) -> None:
        if len(sampled) == 5:
            for worker in house.workers:
                os.kill(pid(worker), signal.SIGKILL)

    house.check(house.sample(kill_all))
    assert house.executor.pool.state.counters["crashed"] == crashed_n + 2
    wait_until(lambda: house.ready(2), 240)


def test_t6_scaling_while_sampling_reaches_its_request_and_loses_nothing(house: House) -> None:
    reached: list[int] = []
    failed: list[Exception] = []

    def scale() -> None:
        try:
            for request in (1, 3, 1, 2):
                assert requests.scale(house.run, request, 240)["ready"] == request
                reached.append(request)
        except Exception as error:  # told by the main thread
            failed.append(error)

    scaling = threading.Thread(target=scale)
    scaling.start()
    deadline_s = time.monotonic() + 1000
    while scaling.is_alive():
        assert time.monotonic() < deadline_s
        house.check(house.sample())
    assert not failed
    assert reached == [1, 3, 1, 2]


def test_a_request_that_is_not_allowed_changes_nothing(house: House) -> None:
    most = statuses.status(house.run)["most"]
    for request in (-1, most + 1):
        with pytest.raises(RunError, match=f"workers must lie in 0 .. {most}"):
            requests.scale(house.run, request)
    assert house.executor.pool.state.wanted == 2


def test_t7_a_worker_with_another_policy_is_found_out(house: House) -> None:
    house.check(house.sample())  # digests of all workers are compared with every episode
    policies, expected = house.executor.transport.policies, policy(house.iteration + 1)
    policies.publish(expected)
    ray.get(policies.source.actor.hold.remote(replace(expected, offset_m=2 * expected.offset_m)))
    with pytest.raises(RunError, match="acted with another policy"):
        house.sample()
    house.executor.pool.state.turn(RunState.DEGRADED, "")
    house.check(house.sample())


def another_server(house: House, before: Process) -> bool:
    """Tick; True when there is one, and it is at work."""
    house.executor.pool.tick(0.02)
    return house.executor.transport.policies.process not in (None, before)


def test_t9_the_policy_server_dies_and_is_back_with_the_newest(house: House, wait_until: Callable[..., None]) -> None:
    policies = house.executor.transport.policies
    killed: list[Process] = []

    def kill(sampled: list[Episode]) -> None:
        if len(sampled) == 5 and policies.process is not None:
            killed.append(policies.process)
            ray.kill(policies.source.actor)

    house.check(house.sample(kill))
    wait_until(lambda: another_server(house, killed[0]), 240)
    back = ray.get(policies.source.actor.pull.remote(house.iteration))
    assert policy_digest(back) == policy_digest(policy(house.iteration))
    with pytest.raises(RunError, match="versions only grow"):
        policies.publish(replace(policy(0), version=house.iteration - VERSIONS_HELD_N))
    house.check(house.sample())


@pytest.mark.parametrize("who", ["supervisor", "worker"])
def test_t9_a_policy_server_that_hangs_is_replaced_when_somebody_misses_it(
    house: House, wait_until: Callable[..., None], who: str
) -> None:
    policies = house.executor.transport.policies
    failures_n = house.executor.ledger.counters["failures"]
    stopped = policies.process
    assert stopped is not None

    def stop(sampled: list[Episode]) -> None:
        if len(sampled) == 1:
            os.kill(stopped.pid, signal.SIGSTOP)
            if who == "worker":
                for worker in house.workers:
                    os.kill(pid(worker), signal.SIGKILL)  # their successors have no policy

    house.check(house.sample(stop))
    assert house.executor.ledger.counters["failures"] == failures_n
    if who == "supervisor":
        house.check(house.sample())
    wait_until(lambda: another_server(house, stopped), 240)
    wait_until(lambda: not processes.command(stopped.pid), 240)


def test_t13_while_the_learner_pauses_nothing_piles_up_and_nothing_is_dropped(
    house: House, wait_until: Callable[..., None]
) -> None:
    pool, ledger = house.executor.pool, house.executor.ledger
    most = bytes_ = 0

    def piled(episode: Episode) -> bool:
        nonlocal most, bytes_
        pool.tick(0.05)
        most = max(most, len(ledger.leases) + ledger.arrived)
        bytes_ = max(bytes_, int(statuses.describe(pool.situation(), None, 8)["bytes_in_flight"]))
        return bytes_ >= 4 * episode.nbytes

    def pause(sampled: list[Episode]) -> None:
        if len(sampled) == 1:
            wait_until(lambda: piled(sampled[0]), 240)
            end_s = time.monotonic() + PAUSE_S
            while time.monotonic() < end_s:
                piled(sampled[0])

    sampled = house.sample(pause)
    assert most == 4
    assert bytes_ == 4 * sampled[0].nbytes
    house.check(sampled)


def test_what_workers_sample_ahead_is_kept_once_and_the_rest_is_left_to_the_next_call(
    house: House, wait_until: Callable[..., None]
) -> None:
    house.iteration += 1
    kept: list[Episode] = []
    house.executor.sample_ahead(house.plans, policy(house.iteration), kept.append)

    def tended() -> bool:
        house.executor.tend()
        return len(kept) >= 5

    wait_until(tended, 240)
    ahead = [episode.episode_id for episode in kept]
    missing = [plan for plan in house.plans if plan.episode_id not in ahead]
    house.check(kept + house.sample_again(missing))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("nan", "column cost holds numbers that are not finite"),
        ("wrong-type", "column cost must be double, found float"),
        ("wrong-shape", "every entry of column nodes must hold 36 numbers"),
        ("wrong-columns", "columns must be"),
    ],
)
def test_t20_data_that_break_their_schema_are_refused_at_the_worker(house: House, fault: str, words: str) -> None:
    number = house.order(3, f"{fault} 1")
    house.check(house.sample())
    (failure,) = house.executor.ledger.failures[number]
    assert (failure.kind, failure.error) == ("raised", "DataError")
    assert words in failure.message


def test_status_names_the_workers_what_is_under_way_and_who_waits(
    house: House, wait_until: Callable[..., None]
) -> None:
    def told(condition: Callable[[dict[str, Any]], bool]) -> Callable[[], bool]:
        def holds() -> bool:
            house.executor.pool.tick(0.02)
            return condition(statuses.status(house.run))

        return holds

    def check(sampled: list[Episode]) -> None:
        if len(sampled) > 1:
            return
        wait_until(told(lambda status: status["leases"] + status["arrived"] == 4), 240)  # with the one not kept yet
        status = statuses.status(house.run)
        assert (status["state"], status["ready"], status["wanted"], status["backlog"]) == ("RUNNING", 2, 2, 30)
        pids = {(worker.id.slot, pid(worker)) for worker in house.workers}
        assert {(worker["slot"], worker["pid"]) for worker in status["workers"]} == pids
        assert status["bytes_in_flight"] > 0

    house.sample(check)
    waits = "2 workers wait for plans"
    wait_until(told(lambda status: waits in [wait["what"] for wait in status["waits"]]), 240)


def test_the_configuration_of_these_tests_is_one_a_run_could_keep() -> None:
    assert parse(Config.model_validate(CONFIG).to_json()) == Config.model_validate(CONFIG)
