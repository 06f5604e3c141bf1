"""Laws of the pool under faults, with real processes that obey orders: what is planned is committed once, and the same.

One Ray serves the module; the workers are stubs, so that an episode takes as long as a test wants.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray

from t6gps.service import bundle, control, deadlines, seeding
from t6gps.service.actors import RayExecutor
from t6gps.service.config import Config, parse
from t6gps.service.pool import Worker
from t6gps.service.sampler import policy_digest
from t6gps.storage import catalog, schema
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.workers import stub
from t6gps.workers.stub import StubWorker

EPISODE_S = 0.1
CONFIG = {"run": {"episodes": 30, "steps": 20, "workers": 2, "cpus_per_worker": 0.5}}


class House:
    """An executor with stub workers, its orders, and one book after another."""

    def __init__(self, root: Path) -> None:
        self.config = Config.model_validate(CONFIG)
        self.run = catalog.create(root, "faults", self.config.to_json())
        self.orders = root / "orders"
        self.orders.mkdir()
        make = partial(StubWorker, episode_s=EPISODE_S, orders=self.orders)
        self.executor = RayExecutor(self.config, self.run, make)
        self.iteration = -1

    def order(self, episode: int, what: str) -> int:
        """Order a fault for an episode of the next book."""
        number = (self.iteration + 1) * self.config.run.episodes + episode
        (self.orders / f"episode-{number}").write_text(what)
        return number

    def sample(self) -> Iterator[Episode]:
        """A new book, with a policy of its own."""
        self.iteration += 1
        yield from self.executor.sample(self.plans, policy(self.iteration))

    @property
    def plans(self) -> list[Any]:
        return seeding.training_plans(self.config, self.iteration)

    @property
    def workers(self) -> list[Worker]:
        return list(self.executor.pool.workers.values())

    def ready(self, n: int) -> bool:
        """Tick; True when there are n workers and all are ready."""
        pool = self.executor.pool
        pool.tick(0.02)
        return len(self.workers) == n and pool.state == "RUNNING"

    def check(self, found: list[Episode], without: tuple[int, ...] = ()) -> None:
        """Every planned episode is there once, and it is what the plan alone makes of it."""
        numbers = [episode.summary["episode_id"][0].as_py() for episode in found]
        expected = {plan.episode_id: plan for plan in self.plans if plan.episode_id not in without}
        assert sorted(numbers) == sorted(expected)
        for number, episode in zip(numbers, found, strict=True):
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


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    house = House(tmp_path_factory.mktemp("faults"))
    with catalog.locked(house.run):
        try:
            house.check(list(house.sample()))  # the deadlines are measured now
            yield house
        finally:
            house.executor.close()


@pytest.fixture
def house(everything: House, wait_until: Callable[..., None]) -> House:
    """Two workers, ready."""
    wait_until(lambda: everything.ready(2), 90)
    return everything


def pid(worker: Worker) -> int:
    assert worker.identity is not None
    return worker.identity.pid


def test_t1_killed_workers_lose_nothing_and_are_replaced(house: House, wait_until: Callable[..., None]) -> None:
    rng = np.random.default_rng(0)
    crashed_n = house.executor.pool.counters["crashed"]
    for _ in range(3):
        found, moment = [], rng.integers(1, 6)
        for episode in house.sample():
            found.append(episode)
            if len(found) == moment:  # the worker that sent it begins another, the other one is somewhere in its own
                os.kill(pid(house.workers[rng.integers(2)]), signal.SIGKILL)
        house.check(found)
        wait_until(lambda: house.ready(2), 90)
    assert house.executor.pool.counters["crashed"] == crashed_n + 3


@pytest.mark.parametrize("how", ["SIGSTOP", "hang-in-c", "hang-in-python"])
def test_t2_a_worker_that_hangs_is_found_replaced_and_its_stacks_kept(
    house: House, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(deadlines, "SHORTEST_S", 2.0)
    number = house.order(9, "slow 1" if how == "SIGSTOP" else f"{how} 1")
    longest_s, stopped = 0.0, False
    tick = house.executor.pool.tick

    def timed(wait_s: float = 0.0) -> None:
        nonlocal longest_s
        start_s = time.monotonic()
        tick(wait_s)
        longest_s = max(longest_s, time.monotonic() - start_s)
        if how == "SIGSTOP" and not stopped:
            stop()

    def stop() -> None:
        nonlocal stopped
        for worker in house.workers:
            if worker.plans and worker.plans[0].episode_id == number:
                os.kill(pid(worker), signal.SIGSTOP)
                stopped = True

    house.executor.pool.tick = timed  # type: ignore[method-assign]
    try:
        found = list(house.sample())
    finally:
        house.executor.pool.tick = tick  # type: ignore[method-assign]
    house.check(found)
    (failure,) = house.executor.ledger.failures[number]
    assert failure.kind == "hang"
    assert {"SIGSTOP": "SIGSTOP", "hang-in-c": "_hang_in_c", "hang-in-python": "_hang_in_python"}[how] in failure.trace
    assert longest_s < 1.0


def test_t3_an_episode_that_raises_three_times_is_left_out_and_can_be_replayed(house: House) -> None:
    number = house.order(4, "raise")
    found = list(house.sample())
    house.check(found, without=(number,))
    kept = bundle.read(house.run.bundles / f"episode-{number}.json")
    assert len(kept.failures) == 3
    assert kept.failures[0]["error"] == "PhysicsError"
    assert kept.failures[0]["step"] == 10
    assert kept.failures[0]["seed"] == kept.plan.seed
    assert "_raise" in kept.failures[0]["trace"]
    assert policy_digest(kept.snapshot) == policy_digest(policy(house.iteration))
    again = bundle.replay(kept, partial(StubWorker, orders=house.orders))
    assert "was ordered to fail" in str(again)
    house.iteration -= 1
    house.check(list(house.sample()), without=(number,))  # it is not tried again


def test_a_worker_that_ends_by_itself_leaves_how_it_ended_and_its_log(house: House) -> None:
    number = house.order(6, "exit 1")
    house.check(list(house.sample()))
    (failure,) = house.executor.ledger.failures[number]
    assert (failure.kind, failure.error) == ("crash", "ActorDiedError")
    assert "exit" in failure.message
    assert len(failure.message) < 300
    assert f"episode {number} was ordered to exit" in failure.log


def test_t4_all_workers_die_at_once_and_the_run_recovers(house: House, wait_until: Callable[..., None]) -> None:
    found, crashed_n = [], house.executor.pool.counters["crashed"]
    for episode in house.sample():
        found.append(episode)
        if len(found) == 5:
            for worker in house.workers:
                os.kill(pid(worker), signal.SIGKILL)
    house.check(found)
    assert house.executor.pool.counters["crashed"] == crashed_n + 2
    wait_until(lambda: house.ready(2), 90)


def test_t6_scaling_while_sampling_reaches_its_wish_and_loses_nothing(house: House) -> None:
    reached: list[int] = []
    failed: list[Exception] = []

    def scale() -> None:
        try:
            for wish in (1, 3, 1, 2):
                assert control.scale(house.run, wish, 90)["ready"] == wish
                reached.append(wish)
        except Exception as error:  # told by the main thread
            failed.append(error)

    scaling = threading.Thread(target=scale)
    scaling.start()
    deadline_s = time.monotonic() + 300
    while scaling.is_alive():
        assert time.monotonic() < deadline_s
        house.check(list(house.sample()))
    assert not failed
    assert reached == [1, 3, 1, 2]
    assert house.executor.ledger.counters["late"] == 0


def test_a_wish_that_is_not_allowed_changes_nothing(house: House) -> None:
    most = control.status(house.run)["most"]
    for wish in (-1, most + 1):
        with pytest.raises(RunError, match=f"workers must lie in 0 .. {most}"):
            control.scale(house.run, wish)
    assert house.executor.pool.wanted == 2


def test_t7_a_worker_with_another_policy_is_found_out(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    house.check(list(house.sample()))  # digests of all workers are compared with every episode
    with monkeypatch.context() as patch:
        patch.setattr("t6gps.service.actors.policy_digest", lambda _: "another")
        with pytest.raises(RunError, match="acted with another policy"):
            list(house.sample())
    house.executor.pool.state = "RUNNING"
    house.check(list(house.sample()))


def test_t9_the_holder_of_the_weights_dies_and_is_back_with_the_newest(
    house: House, wait_until: Callable[..., None]
) -> None:
    transport = house.executor._transport
    found = []
    for episode in house.sample():
        found.append(episode)
        if len(found) == 5:
            before = transport.holders_n
            ray.kill(transport._holder)
    house.check(found)

    def back() -> bool:
        house.executor.pool.tick(0.02)
        return transport.holders_n > before

    wait_until(back, 30)
    assert ray.get(transport._holder.ping.remote()) == house.iteration
    with pytest.raises(RunError, match="versions only grow"):
        transport.publish(policy(house.iteration - 1))
    house.check(list(house.sample()))


def test_t13_while_the_learner_pauses_nothing_piles_up_and_nothing_is_dropped(house: House) -> None:
    episodes = house.sample()
    found = [next(episodes)]
    pool, ledger = house.executor.pool, house.executor.ledger
    pause_s, most, bytes_ = time.monotonic() + 3, 0, 0
    while time.monotonic() < pause_s:
        pool.tick(0.05)
        most = max(most, len(ledger.leases) + ledger.arrived)
        bytes_ = max(bytes_, int(pool.status(time.monotonic())["bytes_in_flight"]))
    assert most == 4
    assert bytes_ == 4 * found[0].frames.nbytes
    house.check(found + list(episodes))


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
    house.check(list(house.sample()))
    (failure,) = house.executor.ledger.failures[number]
    assert (failure.kind, failure.error) == ("raised", "DataError")
    assert words in failure.message


def test_status_names_the_workers_what_is_under_way_and_who_waits(
    house: House, wait_until: Callable[..., None]
) -> None:
    def told(condition: Callable[[dict[str, Any]], bool]) -> Callable[[], bool]:
        def holds() -> bool:
            house.executor.pool.tick(0.02)
            return condition(control.status(house.run))

        return holds

    episodes = house.sample()
    next(episodes)
    wait_until(told(lambda found: found["leases"] + found["arrived"] == 4), 90)  # the episode that is not kept yet, too
    found = control.status(house.run)
    assert (found["state"], found["ready"], found["wanted"], found["backlog"]) == ("RUNNING", 2, 2, 30)
    assert {(worker["slot"], worker["pid"]) for worker in found["workers"]} == {(w.slot, pid(w)) for w in house.workers}
    assert found["bytes_in_flight"] > 0
    list(episodes)
    waits = "2 workers wait for plans"
    wait_until(told(lambda found: waits in [wait["what"] for wait in found["waits"]]), 90)


def test_the_configuration_of_these_tests_is_one_a_run_could_keep() -> None:
    assert parse(Config.model_validate(CONFIG).to_json()) == Config.model_validate(CONFIG)
