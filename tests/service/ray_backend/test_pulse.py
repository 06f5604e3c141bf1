"""A process that stands still is told from one that works, whatever it works at."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from t6gps.service.ray_backend import processes
from t6gps.service.ray_backend.pulse import BEAT_S, Pulse, Watch

BUSY = """
from t6gps.service.ray_backend import pulse
found = pulse.start()
print(found.process.pid, found.process.started, found.process.stacks, found.beats, flush=True)
while True:
    sum(range(1000))
"""


@pytest.fixture
def busy() -> Iterator[Pulse]:
    """A process that computes without end."""
    child = subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        pid, started, stacks, beats = map(int, child.stdout.readline().split())
        yield Pulse(processes.Process(pid, started, stacks), beats)
    finally:
        child.kill()
        child.wait(60)


def test_a_process_that_works_gives_signs_of_life_and_one_that_is_stopped_gives_none(
    busy: Pulse, wait_until: Callable[..., None]
) -> None:
    watch = Watch(busy)
    begun = [watch.silent_s()]
    wait_until(lambda: begun.append(watch.silent_s()) or begun[-1] < begun[-2], 240)  # it has beaten meanwhile
    os.kill(busy.process.pid, signal.SIGSTOP)
    wait_until(lambda: watch.silent_s() > 3 * BEAT_S, 240)
    os.kill(busy.process.pid, signal.SIGCONT)
    wait_until(lambda: watch.silent_s() < BEAT_S, 240)


def test_whoever_has_not_looked_for_a_while_holds_it_against_nobody(busy: Pulse) -> None:
    os.kill(busy.process.pid, signal.SIGSTOP)
    assert Watch(busy).silent_s() == 0.0


def test_a_process_that_has_ended_is_not_said_to_be_silent(busy: Pulse, wait_until: Callable[..., None]) -> None:
    watch = Watch(busy)
    os.kill(busy.process.pid, signal.SIGKILL)
    wait_until(lambda: watch.silent_s() == 0.0, 240)
