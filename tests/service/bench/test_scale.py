"""Laws of the scale on paper: needs follow from costs, and the most workers from needs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench import registry
from t6gps.service.bench.scale import FEW, HEAD, MANY, Costs, IterationCosts, most_workers, needs, of_iterations
from t6gps.service.bench.scaling.paper_pool import PaperTransport, deciding_s
from t6gps.service.execution.wiring import new_learner
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.outside import Nobody
from t6gps.service.pool.pool import Pool
from t6gps.service.pool.state import PoolState
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode, EpisodePlan
from t6gps.workers import stub

COSTS = Costs(
    episode_s=0.1,
    episode_mb=0.4,
    policy_mb=0.2,
    worker_mb=250.0,
    decisions=((10, 0.0002), (100, 0.0006), (1000, 0.003), (10000, 0.03)),
    calls_s=0.001,
    spool_s=0.001,
    iteration=IterationCosts({"fit": 0.01, "supervise": 0.02}, 0.005, disk_mb=0.3, memory_mb=0.7, base_mb=1000.0),
)


def episode(plan: EpisodePlan) -> Episode:
    return stub.episode(plan, new_learner(configuration.load("rough")).policy())


def test_ten_times_the_workers_need_ten_times_as_much_and_more_of_the_supervisor() -> None:
    few, many = needs(COSTS, 10), needs(COSTS, 100)
    assert set(few) == set(HEAD)
    for need in set(few) - {"supervising_s", "memory_gb"}:
        assert many[need] == pytest.approx(10 * few[need])
    assert many["supervising_s"] > 10 * few["supervising_s"]
    base_gb = COSTS.iteration.base_mb / 1e3
    assert many["memory_gb"] - base_gb == pytest.approx(10 * (few["memory_gb"] - base_gb))


def test_ten_workers_need_what_their_episodes_cost() -> None:
    needed = needs(COSTS, 10)  # 100 episodes a second, 100 in an iteration of a second
    assert needed["supervising_s"] == pytest.approx(100 * 0.0022)
    assert needed["learning_s"] == pytest.approx(100 * 0.035)
    assert needed["network_mb"] == pytest.approx(100 * 0.4 + 10 * 0.2)
    assert needed["disk_mb"] == pytest.approx(100 * 0.7)
    assert needed["memory_gb"] == pytest.approx(1.07)
    assert needed["under_way_gb"] == pytest.approx(0.004)


@pytest.mark.parametrize("need", HEAD)
def test_the_most_workers_are_the_last_whose_need_the_head_has(need: str) -> None:
    most = most_workers(COSTS)[need]
    assert needs(COSTS, most)[need] <= HEAD[need] < needs(COSTS, most + 1)[need]


def test_what_doubles_in_cost_carries_half_as_many_workers() -> None:
    dear = replace(COSTS, iteration=replace(COSTS.iteration, learner_s={"fit": 0.025, "supervise": 0.04}))
    assert most_workers(dear)["learning_s"] == most_workers(COSTS)["learning_s"] // 2


def test_beyond_the_largest_pool_on_paper_decisions_take_longer_with_each_worker() -> None:
    assert COSTS.deciding_s(30_000) == pytest.approx(3 * COSTS.deciding_s(10_000))
    assert COSTS.deciding_s(5) == COSTS.deciding_s(10)


def test_workers_on_paper_give_back_every_plan_once_and_in_their_time() -> None:
    plans = seeding.training_plans(configuration.load("rough", ["run.episodes=50"]), 0)
    whole, kept = episode(plans[0]), list[Episode]()
    transport = PaperTransport(5, whole, 1.0)
    state = PoolState(5, "", Ledger(), TIMINGS, EpisodeTimes(TIMINGS.shortest_episode_s))
    pool = Pool(state, transport, Nobody(), lambda _: None, clock=transport.clock)
    pool.open(plans, [], {})
    pool.sample(kept.append)
    assert kept == [whole] * 50
    assert state.ledger.counters["committed"] == 50
    assert {name for name, n in state.ledger.counters.items() if n} == {"committed"}
    assert transport.clock() >= 50 / 5


def test_decisions_on_paper_take_time() -> None:
    config = configuration.load("rough")
    whole = episode(seeding.training_plans(config, 0)[0])
    assert 0 < deciding_s(config, 3, whole, 0.1, 100) < 1


def test_costs_of_an_iteration_are_those_that_its_figures_were_made_of() -> None:
    grown = {}
    for factor in (FEW, MANY):
        n = 20 * factor
        made = {phase.duration_column: 0.01 * n for phase in PHASES} | {"commit_s": 0.002 * n, "disk_mb": 5 + 0.3 * n}
        made |= {"supervisor_peak_mb": 400 + 0.1 * n, "learner_peak_mb": 500 + 0.5 * n}
        grown |= {f"iteration_{factor}x_{key}": value for key, value in made.items()}
    found = of_iterations(grown, 20)
    assert found.learner_s == pytest.approx({phase.name: 0.01 for phase in PHASES})
    assert (found.commit_s, found.disk_mb) == pytest.approx((0.002, 0.3))
    assert (found.memory_mb, found.base_mb) == pytest.approx((0.6, 900))


def test_a_cluster_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    with pytest.raises(ConfigError, match="bench scale measures this machine"):
        registry.measure("scale", lambda _: None)
