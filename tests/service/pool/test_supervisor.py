"""Laws of the supervisor, with a clock and workers that exist on paper: no process, no waiting."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from t6gps.service.pool import supervisor as supervising
from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.control import Control
from t6gps.service.pool.deadlines import FACTOR, TIMINGS, EpisodeTimes
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.supervisor import PLANS_PER_WORKER, Pool
from t6gps.service.pool.transport import Alive, Died, Done, Handle, Identity, Ready, Remains, Report, Transport
from t6gps.service.pool.workers import LONGEST_BACK_OFF_S
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers import stub

POLICY = PolicySnapshot(0, (), 1.0, 0.2)
SETTINGS, START_S, EPISODE_S = "settings", 1.0, 0.5
SHORTEST_S = TIMINGS.shortest_episode_s


def plans(n: int) -> list[EpisodePlan]:
    return [EpisodePlan(i, 0, i, 100 + i, 4, 0, 0.0, 0.1, 0) for i in range(n)]


class Paper(Transport):
    """Workers on paper. Each has a queue, as a process has, and does nothing but what is in `faults`."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.room = 100
        self.alive: dict[int, dict[str, Any]] = {}
        self.killed: list[int] = []
        self.starts: list[tuple[int, int, float]] = []
        self.reports: list[Report] = []
        self.fails_to_start = False
        self.settings = SETTINGS
        self.digest = "policy"
        self.episode_s = EPISODE_S
        self.raising: set[int] = set()
        self.hanging: set[int] = set()
        self.crashing: set[int] = set()
        self.silent: set[int] = set()
        self.most_in_flight = 0
        self.polls_n = 0

    def clock(self) -> float:
        return self.now_s

    def start(self, slot: int, incarnation: int) -> Handle:
        number = len(self.starts)
        self.starts.append((slot, incarnation, self.now_s))
        self.alive[number] = {"ready_s": self.now_s + START_S, "queue": [], "ready": False, "slot": slot, "pings": 0}
        return number

    def send(self, handle: Handle, plan: EpisodePlan) -> None:
        worker = self.alive[handle]
        assert worker["ready"]
        if not worker["queue"]:
            worker["until_s"] = self.now_s + self.episode_s
        worker["queue"].append(plan)
        assert len(worker["queue"]) <= PLANS_PER_WORKER
        self.most_in_flight = max(self.most_in_flight, sum(len(w["queue"]) for w in self.alive.values()))

    def ping(self, handle: Handle) -> None:
        if handle not in self.silent:
            self.reports.append(Alive(handle))

    def poll(self, wait_s: float) -> list[Report]:
        self.now_s += wait_s
        self.polls_n += 1
        assert self.polls_n < 20_000, "the run does not end"
        for handle, worker in list(self.alive.items()):
            if not worker["ready"] and self.now_s >= worker["ready_s"] and self.placed(handle):
                if self.fails_to_start:
                    self.die(handle)
                    continue
                worker["ready"] = True
                self.reports.append(Ready(handle, Identity(handle, "paper", self.settings)))
            while worker["queue"] and self.now_s >= worker["until_s"]:
                if worker["queue"][0].episode_id in self.hanging:
                    break
                if worker["queue"][0].episode_id in self.crashing:
                    self.die(handle)
                    break
                plan = worker["queue"].pop(0)
                worker["until_s"] = self.now_s + self.episode_s
                result: Episode | Failure = stub.episode(plan, POLICY)
                if plan.episode_id in self.raising:
                    result = Failure("raised", "PhysicsError", "it fell over", plan.seed, 2)
                self.reports.append(Done(handle, plan, result, self.digest))
        found, self.reports = self.reports, []
        return found

    def examine(self, handle: Handle) -> Remains:
        return Remains("stacks of " + str(handle), "log")

    def kill(self, handle: Handle) -> None:
        self.alive.pop(handle, None)
        self.killed.append(handle)
        self.reports = [report for report in self.reports if report.handle != handle]

    def placed(self, handle: Handle) -> bool:
        return list(self.alive).index(handle) < self.room

    def free_workers(self) -> int:
        return max(self.room - len(self.alive), 0)

    def die(self, handle: Handle, error: str = "ActorDiedError") -> None:
        """The process ends; its supervisor hears of it."""
        del self.alive[handle]
        self.reports.append(Died(handle, error, "the process ended"))


class Wishes(Control):
    """Control without files."""

    def __init__(self) -> None:
        super().__init__(None, 100)
        self.wished: int | None = None

    def wish(self) -> int | None:
        wished, self.wished = self.wished, None
        return wished


class House:
    """A pool of paper workers, with its ledger."""

    def __init__(self, wanted: int, episodes: int = 0, autoscale: tuple[int, int] | None = None) -> None:
        self.paper, self.ledger, self.wishes = Paper(), Ledger(), Wishes()
        self.quarantined: list[EpisodePlan] = []
        self.pool = Pool(
            self.paper, self.ledger, wanted, SETTINGS, self.wishes, self.quarantined.append, self.paper.clock, autoscale
        )
        self.ledger.open(plans(episodes))
        self.pool.open({0: "policy"})

    def run(self, seconds: float) -> None:
        """Tick for some time of the paper's clock."""
        end_s = self.paper.now_s + seconds
        while self.paper.now_s < end_s:
            self.pool.tick(0.1)

    def until(self, condition: Any, seconds: float) -> float:
        """Tick until the condition holds; how long that took on the paper's clock."""
        start_s = self.paper.now_s
        while not condition():
            assert self.paper.now_s - start_s < seconds, self.pool.reason
            self.pool.tick(0.1)
        return self.paper.now_s - start_s

    @property
    def ready(self) -> int:
        return int(self.pool.status(self.paper.now_s)["ready"])

    def sample(self, after_each: Callable[[list[int]], None] = lambda _: None) -> list[int]:
        """Numbers of the episodes in the order of their arrival; `after_each` sees those that there are so far."""
        found: list[int] = []

        def keep(episode: Episode) -> None:
            found.append(episode.episode_id)
            after_each(found)

        self.pool.sample(keep)
        return found


def test_every_planned_episode_arrives_once() -> None:
    house = House(3, 20)
    assert sorted(house.sample()) == list(range(20))
    assert house.pool.state == "RUNNING"
    assert house.ledger.counters["committed"] == 20


def test_no_worker_has_more_than_two_plans_and_what_waits_for_the_learner_counts() -> None:
    house = House(2, 30)

    def pause(found: list[int]) -> None:
        if len(found) == 1:
            for _ in range(100):  # the learner is busy, the pool is tended
                house.pool.tick(0.1)
            assert len(house.ledger.leases) + house.ledger.arrived == 2 * PLANS_PER_WORKER

    assert len(house.sample(pause)) == 30
    assert house.paper.most_in_flight <= 2 * PLANS_PER_WORKER


def test_large_episodes_are_under_way_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervising, "BYTES_IN_FLIGHT", 1)
    house = House(2, 10)

    def begin_to_count(found: list[int]) -> None:
        if len(found) == 5:
            house.paper.most_in_flight = 0

    assert len(house.sample(begin_to_count)) == 10
    assert house.paper.most_in_flight == 1


def test_a_worker_that_dies_is_replaced_and_its_episodes_are_run_again() -> None:
    house = House(2, 20)

    def kill(found: list[int]) -> None:
        if len(found) == 1:
            house.paper.die(next(iter(house.paper.alive)))

    assert sorted(house.sample(kill)) == list(range(20))
    assert house.pool.workers[0].incarnation == 2
    assert house.until(lambda: house.pool.state == "RUNNING", 5) <= 5


def test_all_workers_die_at_once_and_the_run_recovers_by_itself() -> None:
    house = House(3, 30)

    def kill_all(found: list[int]) -> None:
        if len(found) == 1:
            for handle in list(house.paper.alive):
                house.paper.die(handle)
            house.pool.tick()
            assert house.pool.state == "DEGRADED"
            assert "0 of 3 workers" in house.pool.reason
            assert house.until(lambda: house.pool.state == "RUNNING", 5) <= 5

    assert sorted(house.sample(kill_all)) == list(range(30))


def test_back_off_doubles_up_to_its_cap_and_the_breaker_opens_with_the_reason() -> None:
    house = House(1, 5)
    house.paper.fails_to_start = True
    with pytest.raises(RunError, match=r"5 workers in a row could not start.*the process ended"):
        house.run(600)
    assert house.pool.state == "FAILED"
    times = [at for _, _, at in house.paper.starts]
    waits = [later - earlier - START_S for earlier, later in pairwise(times)]
    assert waits[0] == pytest.approx(0, abs=0.11)
    for found, expected in zip(waits[1:], (0.5, 1.0, 2.0), strict=True):
        assert found == pytest.approx(expected, abs=0.25)


def test_back_off_is_capped_and_a_slot_that_cannot_start_does_not_end_a_run_that_works() -> None:
    house = House(2)
    house.until(lambda: house.ready == 2, 5)
    house.paper.fails_to_start = True
    house.paper.die(house.pool.workers[1].handle)
    house.run(300)
    times = [at for slot, _, at in house.paper.starts if slot == 1]
    assert times[-1] - times[-2] == pytest.approx(LONGEST_BACK_OFF_S + START_S, abs=0.21)
    assert house.pool.state == "DEGRADED"
    assert "the process ended" in house.pool.reason


def test_a_hang_is_found_by_its_deadline_and_its_stacks_are_kept() -> None:
    house = House(2, 30)
    house.paper.hanging.add(7)

    def mend(_: list[int]) -> None:
        if 7 in house.ledger.failures:
            house.paper.hanging.clear()

    assert sorted(house.sample(mend)) == list(range(30))
    (failure,) = house.ledger.failures[7]
    assert (failure.kind, failure.seed) == ("hang", 107)
    assert failure.trace.startswith("stacks of")
    took_s = float(failure.message.split()[-2])
    assert took_s <= max(SHORTEST_S, FACTOR * EPISODE_S) + 0.2
    assert house.pool.counters["hung"] == 1


def test_an_episode_that_hangs_again_gets_twice_the_time() -> None:
    house = House(2, 30)
    house.paper.hanging.add(7)
    assert sorted(house.sample()) == [number for number in range(30) if number != 7]
    first_s, second_s, third_s = (float(failure.message.split()[-2]) for failure in house.ledger.failures[7])
    assert second_s > 1.9 * first_s
    assert third_s > 1.9 * second_s
    assert house.ledger.quarantined == {7}


def test_a_worker_ten_times_slower_does_not_hang() -> None:
    house = House(1, 5)
    house.sample()
    house.paper.episode_s = 10 * EPISODE_S
    house.ledger.open([EpisodePlan(9, 0, 9, 1, 4, 0, 0.0, 0.1, 0)])
    assert house.sample() == [9]
    assert house.pool.counters["hung"] == 0


def test_deadlines_follow_the_measured_times_and_the_length_of_the_episode() -> None:
    times = EpisodeTimes(SHORTEST_S)
    unknown = times.deadline_s(100)
    for _ in range(50):
        times.add(10.0, 100)
    assert times.deadline_s(100) == pytest.approx(FACTOR * 10)
    assert times.deadline_s(1000) == pytest.approx(FACTOR * 100)
    assert times.deadline_s(1) == SHORTEST_S
    assert unknown > 60


def test_an_idle_worker_that_gives_no_sign_of_life_is_replaced() -> None:
    house = House(2)
    house.until(lambda: house.ready == 2, 5)
    house.paper.silent.add(house.pool.workers[0].handle)
    assert house.until(lambda: house.pool.workers[0].incarnation == 2, 25) <= 22
    assert house.pool.workers[1].incarnation == 1


def test_a_poison_episode_is_quarantined_after_three_failures_and_the_run_goes_on() -> None:
    house = House(2, 12)
    house.paper.raising.add(5)
    assert sorted(house.sample()) == [n for n in range(12) if n != 5]
    assert [plan.episode_id for plan in house.quarantined] == [5]
    status = house.pool.status(house.paper.now_s)
    assert status["quarantined"] == [5]
    assert status["episodes"]["failures"] == 3


def test_an_episode_that_kills_its_worker_three_times_is_quarantined() -> None:
    house = House(2, 12)
    house.paper.crashing.add(6)
    assert sorted(house.sample()) == [n for n in range(12) if n != 6]
    assert [failure.kind for failure in house.ledger.failures[6]] == ["crash"] * 3
    assert house.ledger.failures[6][0].log == "log"
    assert house.pool.counters["crashed"] == 3


def test_a_run_in_which_everything_fails_ends_with_one_sentence() -> None:
    house = House(2, 50)
    house.paper.raising = set(range(50))
    with pytest.raises(RunError, match=r"nothing but failures comes back; the last: episode \d+: PhysicsError"):
        house.sample()
    assert house.pool.state == "FAILED"


def test_scaling_reaches_its_wish_while_sampling_and_loses_nothing() -> None:
    house = House(1, 60)
    wishes, asked_s = [3, 1, 2], 0.0

    def scale(_: list[int]) -> None:
        nonlocal asked_s
        if not asked_s:
            house.wishes.wished, asked_s = wishes[0], house.paper.now_s
        assert house.paper.now_s - asked_s <= 5
        if house.ready == wishes[0] == len(house.pool.workers) and len(wishes) > 1:
            wishes.pop(0)
            asked_s = 0.0
        elif len(wishes) == 1:
            asked_s = house.paper.now_s

    assert sorted(house.sample(scale)) == list(range(60))
    assert house.ready == wishes[0] == 2
    assert house.ledger.counters["duplicates"] == 0
    assert house.pool.counters["crashed"] == 0


def test_a_draining_worker_finishes_its_episode_and_hands_the_other_back() -> None:
    house = House(2, 10)
    house.until(lambda: all(len(w.plans) == 2 for w in house.pool.workers.values()) and house.ready == 2, 5)
    kept, given = house.pool.workers[1].plans
    house.wishes.wished = 1
    house.pool.tick()
    assert house.pool.workers[1].draining
    assert list(house.pool.workers[1].plans) == [kept]
    assert given.episode_id not in house.ledger.leases
    house.until(lambda: 1 not in house.pool.workers, 2)
    assert kept.episode_id not in house.ledger.leases  # it arrived
    assert sorted(house.sample()) == list(range(10))


def test_scaled_to_nothing_a_run_pauses_and_goes_on_when_it_is_scaled_up() -> None:
    house = House(2, 10)

    def pause(found: list[int]) -> None:
        if len(found) == 1:
            house.wishes.wished = 0
            house.until(lambda: not house.pool.workers, 5)
            assert house.pool.state == "PAUSED"
            house.wishes.wished = 1

    assert sorted(house.sample(pause)) == list(range(10))


def test_a_worker_that_waits_for_a_cpu_is_named_and_comes_when_there_is_one() -> None:
    house = House(1, 0)
    house.paper.room = 1
    house.until(lambda: house.ready == 1, 5)
    house.wishes.wished = 2
    house.run(5)
    assert house.pool.state == "DEGRADED"
    assert "1 wait for a CPU" in house.pool.reason
    house.run(200)
    assert len(house.paper.starts) == 2  # it is waited for, not started again and again
    house.paper.room += 1  # a node joins
    assert house.until(lambda: house.ready == 2, 5) <= 5


def test_autoscaling_follows_the_backlog_and_the_room() -> None:
    house = House(1, 40, autoscale=(1, 4))
    house.paper.room = 3

    def watch(found: list[int]) -> None:
        if len(found) == 1:
            house.until(lambda: house.ready == 3, 5)
            house.paper.room += 5  # a node joins
            house.until(lambda: house.ready == 4, 5)

    house.sample(watch)
    house.run(TIMINGS.shrink_after_s + 2)
    assert house.ready == 1


def test_a_worker_with_other_settings_or_another_policy_ends_the_run() -> None:
    house = House(1, 3)
    house.paper.settings = "others"
    with pytest.raises(RunError, match="other settings"):
        house.run(5)
    house = House(1, 3)
    house.paper.digest = "another"
    with pytest.raises(RunError, match="another policy than version 0"):
        house.sample()
    assert house.ledger.counters["committed"] == 0
