"""The comparison with other libraries runs, and each of them has a figure."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_every_library_is_measured_in_the_rounds_of_the_service() -> None:
    expected = {"raw_2_steps_per_s", "efficiency_2", "efficiency_2_async_vector_env", "efficiency_2_rllib"}
    assert set(measured("compare.py", "--seconds", "1")) == expected


@pytest.mark.slow
def test_the_answer_of_a_server_is_measured_beside_arrow_flight() -> None:
    expected = {"megabytes", "server_s", "flight_s", "flight_asked_s", "server_over_flight", "server_over_flight_asked"}
    assert set(measured("flight.py", "--megabytes", "1")) == expected


def measured(script: str, *options: str) -> dict[str, float]:
    """The figures that a script of this folder prints, of one round."""
    command = [sys.executable, str(Path(__file__).with_name(script)), "--rounds", "1", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout.splitlines()[-1])
    assert printed["commit"] and printed["cores"] > 0
    assert all(value > 0 for value in printed["results"].values())
    return dict(printed["results"])
