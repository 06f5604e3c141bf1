"""A start of Ray can be given up at any time, and leaves nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
import ray

from t6gps.service import caller
from t6gps.service.ray_backend import private, starting


def abandoned() -> bool:
    return any(thread.name == caller.STARTING for thread in threading.enumerate())


def test_a_start_that_takes_too_long_is_given_up_and_undone(
    wait_until: Callable[..., None], ray_head: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in ray_head.items():
        monkeypatch.setenv(name, value)
    with private.adapted():
        with pytest.raises(TimeoutError, match="no answer within 0 s"), starting.started({}, deadline_s=0.0):
            pass
        assert abandoned()  # nobody has waited for it
        wait_until(lambda: not abandoned(), 120)
    assert not ray.is_initialized()


def test_what_ray_raises_is_raised_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(RuntimeError, match="no_such_option"), starting.started({"no_such_option": 1}):
        pass
    assert not abandoned()
