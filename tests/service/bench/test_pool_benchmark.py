"""`t6gps bench pool` with tiny sizes: every figure is there, and what it cannot measure it refuses."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest
from house import joining

from t6gps.service.bench import pool, registry, rounds
from t6gps.service.bench.contenders import Job, rough_job
from t6gps.service.bench.pool import Sizes
from t6gps.service.bench.registry import Measurement
from t6gps.service.bench.role_clock import ROLES, RoleClock
from t6gps.service.bench.rounds import Contender
from t6gps.service.bench.tally import Tally, machine_s
from t6gps.service.provenance import provenance
from t6gps.storage.errors import ConfigError

EFFICIENCIES = ["efficiency_1", "efficiency_2", "efficiency_2_pipes"]
LATENCIES = ["weight_latency_p95_s", "kill_recovery_p95_s", "hang_recovery_p95_s"]


def ignored(_: str) -> None:
    """Whoever is told how far a benchmark is."""


@pytest.mark.slow
def test_every_figure_is_there_and_positive(ray_head: dict[str, str]) -> None:
    sizes = Sizes(seconds=1.0, rounds=1, versions_n=1, kills_n=1, hangs_n=1, pools=(4,), large_pool_s=1.0)
    lines: list[str] = []
    with joining(ray_head):
        results = pool.measure(sizes, lines.append)
    assert len(lines) == 5 and lines[0].startswith("round 1 of 1: raw_1 ")
    expected = ["raw_1_steps_per_s", "raw_2_steps_per_s", *EFFICIENCIES, *LATENCIES]
    expected += [f"cpu_{efficiency}" for efficiency in EFFICIENCIES]
    expected += [f"cpu_s_per_1000_steps_{role}" for role in ROLES]
    expected += ["pool_4_supervisor_ms"]
    assert not set(expected) - set(results)
    assert all(value is not None and value > 0 for key, value in results.items() if "cpu" not in key)
    for efficiency in EFFICIENCIES:  # on a busy machine a second may be too short for them
        value = results[f"cpu_{efficiency}"]
        assert value is None or value >= 0
    assert results["cpu_s_per_1000_steps_worker"] > results["cpu_s_per_1000_steps_committer"] > 0


def test_less_time_means_fewer_faults_and_smaller_pools() -> None:
    assert Sizes.within(pool.SECONDS, pool.ROUNDS) == Sizes()
    assert Sizes.within(2 * pool.SECONDS, pool.ROUNDS) == Sizes(seconds=2 * pool.SECONDS)
    assert Sizes.within(15.0, 1) == Sizes(15.0, 1, 3, 2, 1, (1, 10, 100), 10.0)


def tally(steps: int, simulating: float) -> Tally:
    """Steps within ten seconds."""
    return Tally(10.0, done=[(100.0, 250), (110.0, steps)], simulating=simulating)


def test_contenders_take_turns_and_every_round_turns_their_order() -> None:
    order: list[str] = []

    def contender(name: str, steps: int) -> Contender:
        def run(_: Job) -> Tally:
            order.append(name)
            return tally(steps * len(order), 0.0)

        return Contender(name, rough_job(1, 1.0), run)

    tallies = rounds.take_turns([contender("a", 10), contender("b", 20)], 2, lambda _: None)
    assert order == ["a", "b", "b", "a"]
    assert [[entry.steps_n for entry in tallies[name]] for name in "ab"] == [[10, 40], [40, 60]]


def test_ratios_are_those_of_a_round_and_their_median_counts() -> None:
    plain = [tally(100, 1.0), tally(200, 0.8), tally(400, 0.5)]
    served = [tally(90, 0.9), tally(100, 0.4), tally(320, 0.5)]
    assert rounds.efficiency(served, plain) == 0.8
    assert rounds.cpu_efficiency(served, plain) == 0.9
    assert rounds.cpu_efficiency(served, [tally(100, 0.0)] * 3) is None
    assert rounds.steps_per_s(plain) == 20.0


def test_a_tally_counts_from_its_first_entry_on() -> None:
    counted = Tally(10.0, done=[(100.0, 250), (105.0, 250), (110.0, 100)])
    assert counted.is_over
    assert counted.steps_per_s == 35.0


def test_of_the_machines_time_what_its_processes_noted_is_simulation(tmp_path: Path) -> None:
    counted = Tally(10.0, done=[(100.0, 250), (110.0, 250)], machine_s=[1000.0, 1020.0])  # two cores
    (tmp_path / "first").write_text("".join(f"{second} 0.9\n" for second in range(99, 112)))  # one before, one after
    (tmp_path / "second").write_text("101.5 0.2\n104.5 1.2\n107.5 1.2\n")  # its first one was begun at no known instant
    counted.read(tmp_path.iterdir())
    assert counted.simulating == pytest.approx((0.9 + 0.4) / 2)


def test_an_idle_core_is_processor_time_too() -> None:
    before_s, begin_s = machine_s(), time.monotonic()
    while time.monotonic() - begin_s < 0.3:
        pass
    cores = (machine_s() - before_s) / (time.monotonic() - begin_s)
    assert 0.2 * os.cpu_count() < cores < 1.2 * os.cpu_count()


def test_a_single_entry_is_no_measurement() -> None:
    assert not Tally(0.0).add(1)


def test_what_this_process_spends_is_the_supervisors_and_the_committers() -> None:
    clock = RoleClock()
    clock.start()
    with clock.of("committer"):
        sum(range(300_000))
    sum(range(300_000))
    spent = clock.spent_s()
    assert spent["committer"] > 0 and spent["supervisor"] > 0
    assert spent["learner"] == 0


@pytest.mark.parametrize(("seconds", "rounds"), [(0.0, 5), (30.0, 0)])
def test_sizes_that_measure_nothing_are_refused(seconds: float, rounds: int) -> None:
    with pytest.raises(ConfigError, match="seconds > 0 and rounds >= 1"):
        registry.measure("pool", ignored, seconds=seconds, rounds=rounds)


def test_a_cluster_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    with pytest.raises(ConfigError, match="unset it"):
        registry.measure("pool", ignored)


def test_a_measurement_says_where_it_comes_from() -> None:
    measured = Measurement("pool", provenance(), 1, ("a note",), {"speed": 1.5, "nothing": None})
    record = json.loads(measured.to_json())
    assert record["commit"] == measured.provenance.commit
    assert record["results"] == {"speed": 1.5, "nothing": None}
    origin = {"commit", "date", "platform", "processor", "blas", "cores", "versions"}
    assert set(record) == origin | {"bench", "threads", "notes", "results"}


def test_other_benchmarks_have_no_sizes() -> None:
    with pytest.raises(ConfigError, match="bench physics has no --seconds"):
        registry.measure("physics", ignored, seconds=1.0)
