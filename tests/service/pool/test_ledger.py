"""Laws of the ledger: executed at least once, committed exactly once."""

from __future__ import annotations

import random

import pytest

from t6gps.service.pool.attempt import Failure, FailureKind
from t6gps.service.pool.ledger import ATTEMPTS_ALLOWED_N, FAILURES_ALLOWED_N, HOPELESS_N, Ledger
from t6gps.storage.records import EpisodePlan


def plans(n: int, iteration: int = 0) -> list[EpisodePlan]:
    return [EpisodePlan(i, iteration, i, 100 + i, 10, 0, 0.0, 0.1, iteration) for i in range(n)]


def failure(kind: str = "raised") -> Failure:
    return Failure(FailureKind(kind), "PhysicsError", "it fell over", seed=1, step=3)


@pytest.fixture
def ledger() -> Ledger:
    return Ledger()


def test_plans_are_leased_in_their_order_and_each_to_one_worker(ledger: Ledger) -> None:
    ledger.open(plans(3))
    leased = [ledger.lease(slot, 1) for slot in range(4)]
    assert leased == [*plans(3), None]
    assert (ledger.backlog, ledger.waiting, len(ledger.leases)) == (3, 0, 3)


def test_what_is_given_back_is_leased_next_in_its_old_order(ledger: Ledger) -> None:
    ledger.open(plans(4))
    first, second, _ = ledger.lease(0, 1), ledger.lease(0, 1), ledger.lease(1, 1)
    assert ledger.give_back(0, 1) == [first, second]
    assert [ledger.lease(2, 1) for _ in range(3)] == [first, second, plans(4)[3]]


def test_a_draining_worker_keeps_the_lease_it_is_at_work_on(ledger: Ledger) -> None:
    ledger.open(plans(2))
    ledger.lease(0, 1), ledger.lease(0, 1)
    assert ledger.give_back(0, 1, keep=0) == [plans(2)[1]]
    assert list(ledger.leases) == [0]


def test_an_episode_counts_once_whoever_brings_it(ledger: Ledger) -> None:
    plan = plans(1)[0]
    ledger.open([plan])
    ledger.lease(0, 1)
    ledger.give_back(0, 1)
    ledger.lease(1, 1)
    assert ledger.arrive(plan)
    assert not ledger.arrive(plan)
    ledger.commit(0)
    assert not ledger.arrive(plan)
    assert (ledger.counters["committed"], ledger.counters["duplicates"]) == (1, 2)


def test_a_result_of_a_lease_that_was_given_up_is_taken_and_not_run_again(ledger: Ledger) -> None:
    plan = plans(1)[0]
    ledger.open([plan])
    ledger.lease(0, 1)
    ledger.give_back(0, 1)
    assert ledger.arrive(plan)
    assert ledger.lease(1, 1) is None


def test_what_comes_from_another_iteration_is_late_and_counted(ledger: Ledger) -> None:
    ledger.open(plans(1))
    old = ledger.lease(0, 1)
    ledger.open(plans(1, iteration=1))
    assert old is not None
    assert not ledger.arrive(old)
    assert ledger.counters["late"] == 1
    assert ledger.backlog == 1


def test_leases_of_the_same_plans_outlive_a_new_batch(ledger: Ledger) -> None:
    ledger.open(plans(3))
    ledger.lease(0, 1)
    ledger.open(plans(3))
    assert list(ledger.leases) == [0]
    assert ledger.waiting == 2


def test_an_episode_that_fails_three_times_is_quarantined_and_nothing_else_is(ledger: Ledger) -> None:
    failing, sound = plans(2)
    ledger.open([failing, sound])
    for attempt in range(1, FAILURES_ALLOWED_N + 1):
        assert ledger.lease(0, 1) == failing
        assert ledger.fail(failing, failure()) == (attempt == FAILURES_ALLOWED_N)
    assert ledger.lease(0, 1) == sound
    assert ledger.quarantined == {0}
    assert len(ledger.failures[0]) == FAILURES_ALLOWED_N
    assert (ledger.counters["failures"], ledger.counters["quarantined"]) == (3, 1)


def test_an_episode_whose_worker_is_lost_is_not_at_fault_until_no_accident_explains_it(ledger: Ledger) -> None:
    (plan,) = plans(1)
    ledger.open([plan])
    for attempt in range(1, ATTEMPTS_ALLOWED_N + 1):
        assert ledger.lease(0, 1) == plan
        assert ledger.fail(plan, failure("lost")) == (attempt == ATTEMPTS_ALLOWED_N)
    assert (ledger.counters["lost"], ledger.counters["failures"]) == (ATTEMPTS_ALLOWED_N, 0)


def test_lost_attempts_do_not_add_to_failures(ledger: Ledger) -> None:
    (plan,) = plans(1)
    ledger.open([plan])
    kinds = ["lost", "crash", "lost", "lost", "hang", "lost", "raised"]
    for kind in kinds:
        ledger.lease(0, 1)
        assert ledger.fail(plan, failure(kind)) == (kind == "raised")


def test_quarantined_episodes_are_left_out_of_a_new_batch(ledger: Ledger) -> None:
    ledger.open(plans(3), quarantined=[1])
    leased = [ledger.lease(0, 1) for _ in range(3)]
    assert leased == [plans(3)[0], plans(3)[2], None]


def test_nothing_but_failures_is_hopeless_and_a_single_failing_seed_is_not(ledger: Ledger) -> None:
    batch = plans(HOPELESS_N + 1)
    ledger.open(batch)
    for plan in batch[:HOPELESS_N]:
        assert not ledger.hopeless
        for _ in range(FAILURES_ALLOWED_N):
            ledger.lease(0, 1)
            ledger.fail(plan, failure())
    assert ledger.hopeless
    again = Ledger()
    again.open(batch[:1])
    for _ in range(FAILURES_ALLOWED_N):
        again.lease(0, 1)
        again.fail(batch[0], failure())
    assert again.hopeless  # it was all there was
    mixed = Ledger()
    mixed.open(batch[:2])
    mixed.lease(0, 1)
    mixed.arrive(batch[0])
    mixed.commit(0)
    for _ in range(FAILURES_ALLOWED_N):
        mixed.lease(0, 1)
        mixed.fail(batch[1], failure())
    assert not mixed.hopeless


def test_counters_go_on_after_a_restart(ledger: Ledger) -> None:
    ledger.open(plans(1))
    ledger.lease(0, 1)
    ledger.arrive(plans(1)[0])
    ledger.commit(0)
    resumed = Ledger()
    resumed.restore(ledger.state())
    assert resumed.counters == ledger.counters
    resumed.restore(None)  # a checkpoint of a run that had no ledger
    assert resumed.counters == ledger.counters


@pytest.mark.parametrize("seed", range(20))
def test_whatever_happens_every_plan_is_committed_once(ledger: Ledger, seed: int) -> None:
    """Random leases, losses, duplicates and failures, two per episode at most."""
    rng, batch = random.Random(seed), plans(12)
    ledger.open(batch)
    failed = dict.fromkeys(range(12), 0)
    committed: list[int] = []
    sent: list[EpisodePlan] = []
    for _ in range(2000):
        if not ledger.backlog:
            break
        slot = rng.randrange(3)
        action = rng.random()
        if action < 0.5:
            plan = ledger.lease(slot, 1)
            sent += [plan] if plan else []
        elif action < 0.6:
            ledger.give_back(slot, 1)
        elif sent:
            plan = rng.choice(sent)
            if action < 0.65 and failed[plan.episode_id] < 2 and plan.episode_id in ledger.leases:
                failed[plan.episode_id] += 1
                assert not ledger.fail(plan, failure())
            elif ledger.arrive(plan):
                ledger.commit(plan.episode_id)
                committed.append(plan.episode_id)
    assert sorted(committed) == list(range(12))
    assert ledger.counters["committed"] == 12
