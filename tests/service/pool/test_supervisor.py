"""Laws of the supervisor, with a clock and workers that exist on paper: no process, no waiting."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from paper import EPISODE_S, SHORTEST_S, START_S, House, plans

from t6gps.service.pool.deadlines import FACTOR, TIMINGS, EpisodeTimes
from t6gps.service.pool.scaling import PLANS_PER_WORKER
from t6gps.service.pool.state import (
    LONGEST_BACK_OFF_S,
    NEXT_PHASES,
    NEXT_STATES,
    WorkerPhase,
)
from t6gps.service.pool.supervisor import GRACE_S
from t6gps.service.steering import status
from t6gps.storage.errors import RunError
from t6gps.storage.records import EpisodePlan


def test_every_planned_episode_arrives_once() -> None:
    house = House(3, 20)
    assert sorted(house.sample()) == list(range(20))
    assert house.pool.state.condition == "RUNNING"
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


def test_large_episodes_are_under_way_one_by_one() -> None:
    house = House(2, 10, bytes_in_flight=1)

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
    assert house.pool.state.workers[0].id.incarnation == 2
    assert house.until(lambda: house.pool.state.condition == "RUNNING", 5) <= 5


def test_all_workers_die_at_once_and_the_run_recovers_by_itself() -> None:
    house = House(3, 30)

    def kill_all(found: list[int]) -> None:
        if len(found) == 1:
            for handle in list(house.paper.alive):
                house.paper.die(handle)
            house.pool.tick()
            assert house.pool.state.condition == "DEGRADED"
            assert "0 of 3 workers" in house.pool.state.reason
            assert house.until(lambda: house.pool.state.condition == "RUNNING", 5) <= 5

    assert sorted(house.sample(kill_all)) == list(range(30))


def test_back_off_doubles_up_to_its_cap_and_the_breaker_opens_with_the_reason() -> None:
    house = House(1, 5)
    house.paper.fails_to_start = True
    with pytest.raises(RunError, match=r"5 workers in a row could not start.*the process ended"):
        house.run(600)
    assert house.pool.state.condition == "FAILED"
    times = [at for _, _, at in house.paper.starts]
    waits = [later - earlier - START_S for earlier, later in pairwise(times)]
    assert waits[0] == pytest.approx(0, abs=0.11)
    for found, expected in zip(waits[1:], (0.5, 1.0, 2.0), strict=True):
        assert found == pytest.approx(expected, abs=0.25)


def test_back_off_is_capped_and_a_slot_that_cannot_start_does_not_end_a_run_that_works() -> None:
    house = House(2)
    house.until(lambda: house.ready == 2, 5)
    house.paper.fails_to_start = True
    house.paper.die(house.pool.state.workers[1].id)
    house.run(300)
    times = [at for slot, _, at in house.paper.starts if slot == 1]
    assert times[-1] - times[-2] == pytest.approx(LONGEST_BACK_OFF_S + START_S, abs=0.21)
    assert house.pool.state.condition == "DEGRADED"
    assert "the process ended" in house.pool.state.reason


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
    assert house.pool.state.counters["hung"] == 1


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
    house.pool.open([EpisodePlan(9, 0, 9, 1, 4, 0, 0.0, 0.1, 0)], [], {0: "policy"})
    assert house.sample() == [9]
    assert house.pool.state.counters["hung"] == 0


def test_an_episode_took_as_long_as_it_took_however_late_the_supervisor_looks() -> None:
    house = House(1, 6)
    late_s = 50 * EPISODE_S

    def stand_still(found: list[int]) -> None:
        if len(found) == 3:
            house.paper.now_s += late_s

    assert sorted(house.sample(stand_still)) == list(range(6))
    steps_n = plans(1)[0].steps
    assert max(house.pool.state.times.per_step_s) * steps_n < 2 * EPISODE_S


def test_after_a_pause_of_the_supervisor_itself_nobody_is_late_at_once() -> None:
    house = House(2, 10)
    house.until(lambda: len(house.ledger.leases) == 2 * PLANS_PER_WORKER, 5)
    house.paper.hold_back = True  # what the workers did is still on its way when the supervisor looks again
    house.paper.now_s += 10_000
    house.pool.tick()
    house.paper.hold_back = False
    assert sorted(house.sample()) == list(range(10))
    assert house.pool.state.counters["hung"] == 0


def test_a_worker_that_hangs_through_a_pause_of_the_supervisor_is_found_after_it() -> None:
    house = House(1, 3)
    house.paper.hanging.add(0)
    house.until(lambda: bool(house.ledger.leases), 5)
    house.paper.now_s += 10_000
    assert house.until(lambda: house.pool.state.counters["hung"] == 1, 5) <= GRACE_S + 0.2


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
    house.paper.silent.add(house.pool.state.workers[0].id)
    assert house.until(lambda: house.pool.state.workers[0].id.incarnation == 2, 25) <= 22
    assert house.pool.state.workers[1].id.incarnation == 1


def test_an_episode_that_always_raises_is_quarantined_after_three_failures_and_the_run_continues() -> None:
    house = House(2, 12)
    house.paper.raising.add(5)
    assert sorted(house.sample()) == [n for n in range(12) if n != 5]
    assert [plan.episode_id for plan in house.quarantined] == [5]
    found = status.describe(house.pool.situation(), None, 8)
    assert found["quarantined"] == [5]
    assert found["episodes"]["failures"] == 3


def test_an_episode_that_kills_its_worker_three_times_is_quarantined() -> None:
    house = House(2, 12)
    house.paper.crashing.add(6)
    assert sorted(house.sample()) == [n for n in range(12) if n != 6]
    assert [failure.kind for failure in house.ledger.failures[6]] == ["crash"] * 3
    assert house.ledger.failures[6][0].log == "log"
    assert house.pool.state.counters["crashed"] == 3


def test_a_run_in_which_everything_fails_ends_with_one_sentence() -> None:
    house = House(2, 50)
    house.paper.raising = set(range(50))
    with pytest.raises(RunError, match=r"nothing but failures comes back; the last: episode \d+: PhysicsError"):
        house.sample()
    assert house.pool.state.condition == "FAILED"


def test_scaling_reaches_what_was_asked_while_sampling_and_loses_nothing() -> None:
    house = House(1, 60)
    requests_left, asked_s = [3, 1, 2], 0.0

    def scale(_: list[int]) -> None:
        nonlocal asked_s
        if not asked_s:
            house.scale(requests_left[0])
            asked_s = house.paper.now_s
        assert house.paper.now_s - asked_s <= 5
        if house.ready == requests_left[0] == len(house.pool.state.workers) and len(requests_left) > 1:
            requests_left.pop(0)
            asked_s = 0.0
        elif len(requests_left) == 1:
            asked_s = house.paper.now_s

    assert sorted(house.sample(scale)) == list(range(60))
    assert house.ready == requests_left[0] == 2
    assert house.ledger.counters["duplicates"] == 0
    assert house.pool.state.counters["crashed"] == 0


def test_a_draining_worker_finishes_its_episode_and_hands_the_other_back() -> None:
    house = House(2, 10)
    house.until(lambda: all(len(w.plans) == 2 for w in house.pool.state.workers.values()) and house.ready == 2, 5)
    kept, given = house.pool.state.workers[1].plans
    house.scale(1)
    house.pool.tick()
    assert house.pool.state.workers[1].phase == WorkerPhase.DRAINING
    assert list(house.pool.state.workers[1].plans) == [kept]
    assert given.episode_id not in house.ledger.leases
    house.until(lambda: 1 not in house.pool.state.workers, 2)
    assert kept.episode_id not in house.ledger.leases  # it arrived
    assert sorted(house.sample()) == list(range(10))


def test_scaled_to_nothing_a_run_pauses_and_goes_on_when_it_is_scaled_up() -> None:
    house = House(2, 10)

    def pause(found: list[int]) -> None:
        if len(found) == 1:
            house.scale(0)
            house.until(lambda: not house.pool.state.workers, 5)
            assert house.pool.state.condition == "PAUSED"
            house.scale(1)

    assert sorted(house.sample(pause)) == list(range(10))


def test_a_worker_that_waits_for_a_cpu_is_named_and_comes_when_there_is_one() -> None:
    house = House(1, 0)
    house.paper.room = 1
    house.until(lambda: house.ready == 1, 5)
    house.scale(2)
    house.run(5)
    assert house.pool.state.condition == "DEGRADED"
    assert "1 wait for a CPU" in house.pool.state.reason
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


def test_autoscaling_asks_for_the_room_that_it_lacks_and_gives_it_back() -> None:
    house = House(1, 40, autoscale=(1, 4))
    house.paper.room = 1

    def watch(found: list[int]) -> None:
        if len(found) == 1:
            assert house.paper.nodes_asked == [4]
            assert house.ready == 1
            house.paper.room = 4  # the cluster has grown
            house.until(lambda: house.ready == 4, 5)

    house.sample(watch)
    assert house.paper.nodes_asked == [4]  # as long as the workers are there
    house.run(TIMINGS.shrink_after_s + 2)
    assert house.paper.nodes_asked == [4, 1]
    house.scale(2)
    house.pool.tick()
    assert house.paper.nodes_asked == [4, 1, 0]  # scaled by hand, workers that wait for a CPU ask for it themselves


def test_a_worker_with_other_settings_another_installation_or_another_policy_ends_the_run() -> None:
    house = House(1, 3)
    house.paper.settings = "others"
    with pytest.raises(RunError, match="other settings"):
        house.run(5)
    house = House(1, 3)
    house.pool.state.build = {"t6gps": "0.3", "schema": "5", "compiled learner._backward": "aa"}
    house.paper.build = {"t6gps": "0.3", "schema": "4"}
    differences = r"schema 4 \(the run: 5\), compiled learner._backward none \(the run: aa\)"
    with pytest.raises(RunError, match=rf"on node paper has another installation than the run: {differences}; install"):
        house.run(5)
    house = House(1, 3)
    house.paper.digest = "another"
    with pytest.raises(RunError, match="another policy than version 0"):
        house.sample()
    assert house.ledger.counters["committed"] == 0


def test_a_resumed_batch_whose_only_missing_episode_fails_does_not_end_the_run() -> None:
    house = House(2)
    house.ledger.worked = True  # the others are durable
    house.paper.raising.add(0)
    house.pool.open(plans(1), [], {0: "policy"})
    assert house.sample() == []
    assert house.ledger.quarantined == {0}
    assert house.pool.state.condition == "RUNNING"


@pytest.mark.parametrize("phases", [NEXT_PHASES, NEXT_STATES], ids=["worker", "run"])
def test_every_state_is_in_its_table_of_transitions(phases: dict[Any, set[Any]]) -> None:
    assert set(phases) == set(type(next(iter(phases))))


def test_the_status_counts_the_time_in_each_phase_and_since_the_newest_episode() -> None:
    house = House(2, 12)
    assert status.describe(house.pool.situation(), None, 8)["durable_for_s"] is None
    house.sample()
    sampled_s = status.describe(house.pool.situation(), None, 8)["phases_s"]["sampling"]
    for phase in ("fit", "commit", "fit"):
        house.pool.phases.enter(phase)
        house.run(2)
    found = status.describe(house.pool.situation(), None, 8)
    assert found["phase"] == "fit"
    spent_s = found["phases_s"]
    assert sampled_s > 0
    assert spent_s["sampling"] == sampled_s
    assert (spent_s["fit"], spent_s["commit"]) == (pytest.approx(4, abs=0.3), pytest.approx(2, abs=0.3))
    assert found["durable_for_s"] == pytest.approx(6, abs=0.5)
