"""`t6gps bench pool` with tiny sizes: every figure is there, and what it cannot measure it refuses."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from t6gps.service.bench import pool, registry
from t6gps.service.bench.role_clock import ROLES, RoleClock
from t6gps.service.bench.tally import Tally, machine_s
from t6gps.storage.errors import ConfigError

EFFICIENCIES = ["efficiency_1"] + [f"efficiency_2{peer}" for peer in ("", "_pipes", "_async_vector_env", "_rllib")]
CPU_EFFICIENCIES = ["cpu_efficiency_1", "cpu_efficiency_2", "cpu_efficiency_2_pipes"]
LATENCIES = ["weight_latency_p95_s", "kill_recovery_p95_s", "hang_recovery_p95_s"]


@pytest.mark.slow
def test_every_figure_is_there_and_positive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "SIZES", (600, 1200))
    found = registry.measure("pool", seconds=1.0, rounds=1)
    assert found["notes"] == list(pool.NOTES)
    results = found["results"]
    expected = ["raw_1_steps_per_s", "raw_2_steps_per_s", *EFFICIENCIES, *CPU_EFFICIENCIES, *LATENCIES]
    expected += [f"cpu_s_per_1000_steps_{role}" for role in ROLES]
    expected += [f"pool_{n}_supervisor_ms" for n in (4, 8)]
    assert not set(expected) - set(results)
    assert all(value is not None and value > 0 for key, value in results.items() if "cpu_s" not in key)
    assert results["cpu_s_per_1000_steps_worker"] > results["cpu_s_per_1000_steps_committer"] > 0


def test_a_peer_that_is_not_installed_is_left_out_with_a_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "t6gps.service.bench.rllib_policy", None)
    peers = pool._peers()
    assert peers["efficiency_2_rllib"] is None
    assert peers["efficiency_2_async_vector_env"] is not None
    assert "rllib takes no part" in capsys.readouterr().err


def test_a_tally_counts_from_its_first_entry_on() -> None:
    tally = Tally(10.0)
    tally.done = [(100.0, 250), (105.0, 250), (110.0, 100)]
    assert tally.is_over
    assert tally.steps_per_s == 35.0


def test_of_the_machines_time_what_its_processes_noted_is_simulation(tmp_path: Path) -> None:
    tally = Tally(10.0)
    tally.done = [(100.0, 250), (110.0, 250)]
    tally._machine_s = [1000.0, 1020.0]  # two cores
    (tmp_path / "one").write_text("".join(f"{second} 0.9\n" for second in range(99, 112)))  # one before, one after
    (tmp_path / "two").write_text("101.5 0.2\n104.5 1.2\n107.5 1.2\n")  # its first one was begun at no known instant
    tally.read(tmp_path.iterdir())
    assert tally.simulating == pytest.approx((0.9 + 0.4) / 2)


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
        registry.measure("pool", seconds=seconds, rounds=rounds)


def test_a_cluster_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    with pytest.raises(ConfigError, match="unset it"):
        registry.measure("pool")


def test_other_benchmarks_have_no_sizes() -> None:
    with pytest.raises(ConfigError, match="bench physics has no --seconds"):
        registry.measure("physics", seconds=1.0)
