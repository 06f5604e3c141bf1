"""Laws of stopping: a request is heeded wherever Ctrl-C is, in any thread, once, and never after the run."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from command import started

from t6gps.service.steering import requests
from t6gps.service.steering.watch import heeding
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

DEADLINE_S = 60.0


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    """Ctrl-C means KeyboardInterrupt and ends a wait, whatever other tests of this process have left."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before or signal.default_int_handler)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return catalog.create(tmp_path, "watched", "{}")


def ask(run: Run) -> None:
    """Ask the run to stop, without waiting."""
    with suppress(RunError):
        requests.stop(run, 0.0)


def work(run: Run, begun: threading.Event) -> str:
    """What a run's process does, until it is interrupted."""
    with catalog.locked(run):
        try:
            with heeding(run):
                begun.set()
                deadline = time.monotonic() + DEADLINE_S
                while time.monotonic() < deadline:
                    time.sleep(0.01)  # the run's work, which the interrupt ends
        except KeyboardInterrupt:
            return "interrupted"
    return "not interrupted"


def test_a_stop_interrupts_the_main_thread_also_where_it_waits_in_the_system(run: Run) -> None:
    assert threading.current_thread() is threading.main_thread()
    with catalog.locked(run):
        ask(run)
        begun_s = time.monotonic()
        with pytest.raises(KeyboardInterrupt), heeding(run):
            threading.Event().wait(DEADLINE_S)
    assert time.monotonic() - begun_s < DEADLINE_S / 2


def test_a_stop_interrupts_a_run_in_another_thread_and_not_the_main_one(run: Run) -> None:
    begun, said = threading.Event(), list[str]()
    thread = threading.Thread(target=lambda: said.append(work(run, begun)))
    thread.start()
    assert begun.wait(DEADLINE_S)
    ask(run)
    thread.join(DEADLINE_S)
    assert said == ["interrupted"]


def test_a_stop_is_heeded_where_the_program_has_its_own_handler_of_ctrl_c(run: Run) -> None:
    own = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        with catalog.locked(run):
            ask(run)
            with pytest.raises(KeyboardInterrupt), heeding(run):
                deadline = time.monotonic() + DEADLINE_S
                while time.monotonic() < deadline:
                    time.sleep(0.01)
    finally:
        signal.signal(signal.SIGINT, own)


def test_nothing_is_interrupted_after_the_run(run: Run) -> None:
    with catalog.locked(run):
        with heeding(run):
            pass
        ask(run)
        assert not [thread for thread in threading.enumerate() if thread.name == "t6gps stop"]


@pytest.mark.slow
def test_a_run_in_one_process_is_stopped_and_resumes(tmp_path: Path, wait_until: Callable[..., None]) -> None:
    tiny = [f"--set={each}" for each in ("run.iterations=1", "run.episodes=400", "run.steps=50")]
    command = ["train", "flat-quick", "--run", "one", "--serial", "--root", tmp_path, *tiny]
    process = started(*command)
    try:
        wait_until(lambda: any(tmp_path.glob("one/spool/*/episode-*")), 240)
        assert requests.stop(catalog.open_run(tmp_path, "one")) == "STOPPED; --resume continues it"
        _, message = process.communicate(timeout=240)
    finally:
        process.kill()
    assert process.returncode == 130
    assert b"--resume" in message
    assert b"Traceback" not in message
