"""The comparison with other libraries runs, and each of them has a figure."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_every_library_is_measured_in_the_rounds_of_the_service() -> None:
    command = [sys.executable, str(Path(__file__).with_name("compare.py")), "--seconds", "1", "--rounds", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout.splitlines()[-1])
    assert measured["commit"] and measured["cores"] > 0
    expected = {"raw_2_steps_per_s", "efficiency_2", "efficiency_2_async_vector_env", "efficiency_2_rllib"}
    assert set(measured["results"]) == expected
    assert all(value > 0 for value in measured["results"].values())
