"""What is replaced again and again ends the run with its cause."""

from __future__ import annotations

import pytest

from t6gps.service.ray_backend.deaths import ALLOWED_N, WINDOW_S, Deaths
from t6gps.storage.errors import RunError


def test_a_role_that_dies_too_often_ends_the_run_with_the_last_cause() -> None:
    deaths = Deaths("the policy server", clock=lambda: 7.0)
    for number in range(ALLOWED_N):
        deaths.add(f"cause {number}")
    with pytest.raises(RunError, match=r"the policy server has failed 6 times.*too many open files.*--resume"):
        deaths.add("too many open files")


def test_deaths_that_lie_apart_are_no_reason_to_end() -> None:
    now_s = [0.0]
    deaths = Deaths("the policy server", clock=lambda: now_s[0])
    for _ in range(10 * ALLOWED_N):
        deaths.add("killed")
        now_s[0] += 1.01 * WINDOW_S / ALLOWED_N
