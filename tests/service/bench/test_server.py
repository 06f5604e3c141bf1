"""`t6gps bench server` with turns of a second: every figure is there, and what it cannot measure it refuses."""

from __future__ import annotations

import pytest
from house import joining

from t6gps.service.bench import server
from t6gps.storage.errors import ConfigError


@pytest.mark.slow
def test_a_server_with_slow_and_dead_clients_is_measured_beside_a_pool(ray_head: dict[str, str]) -> None:
    lines: list[str] = []
    with joining(ray_head):
        figures = server.measure(lines.append, seconds=1.0, rounds=1)
    assert [line.split(" clients ")[0] for line in lines] == ["without", "with"]
    assert figures.keys() == {
        "status_p50_ms",
        "status_p95_ms",
        "pool_ratio",
        "pool_steps_per_s",
        "server_share",
        "clients_share",
        "server_cpu_ms_per_status",
        "server_peak_mb",
    }
    assert all(value is not None and value > 0 for value in figures.values())


def test_turns_that_measure_nothing_are_refused() -> None:
    with pytest.raises(ConfigError, match="needs seconds > 0 and rounds >= 1, found 0 and 1"):
        server.server(lambda _: None, seconds=0.0, rounds=1)
