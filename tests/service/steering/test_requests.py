"""Laws of requests: the last one holds, whoever was overtaken is told at once, and nothing outlives its process."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from paper import House

from t6gps.service.pool.messages import UnpauseRequested
from t6gps.service.pool.state import RunState
from t6gps.service.steering import events, requests, status
from t6gps.service.steering.desk import Desk
from t6gps.service.steering.requests import Inbox, What
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

LONG_S = 120.0
"""Nobody waits so long where the law is that something happens at once."""


class Asking(threading.Thread):
    """Asks in a thread, as another process would; `answer` is what it is told, an error included."""

    def __init__(self, ask: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._ask = ask
        self.answer: object = None
        self.start()

    def run(self) -> None:
        try:
            self.answer = self._ask()
        except RunError as error:
            self.answer = error


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """A run that this process has."""
    created = catalog.create(tmp_path, "asked", "{}")
    with catalog.locked(created):
        yield created


@pytest.fixture
def house(run: Run) -> House:
    """A pool of two paper workers, steered from the run's folder, at work."""
    steered = House(2, outside=Desk(run, 8))
    steered.until(lambda: steered.ready == 2, 5)
    return steered


def until_told(house: House, asking: Asking, wait_until: Callable[..., None]) -> object:
    """Tick until somebody has an answer."""

    def told() -> bool:
        house.pool.tick(0.1)
        return not asking.is_alive()

    wait_until(told, LONG_S / 2)
    return asking.answer


def asked_for(run: Run, what: What) -> Callable[[], bool]:
    """Whether somebody has asked that."""

    def asked() -> bool:
        last = requests.read(run)
        return last is not None and last.what is what

    return asked


def test_who_is_overtaken_is_told_so_at_once_and_the_other_gets_what_was_asked(
    house: House, run: Run, wait_until: Callable[..., None]
) -> None:
    first = Asking(lambda: requests.scale(run, 3, LONG_S))
    wait_until(asked_for(run, What.WORKERS), 60)
    second = Asking(lambda: requests.scale(run, 1, LONG_S))
    first.join(LONG_S / 2)  # the run itself has not even looked yet
    assert isinstance(first.answer, RunError)
    assert "for 3 workers was overtaken" in str(first.answer)
    assert "for 1 workers meanwhile" in str(first.answer)
    answer = until_told(house, second, wait_until)
    assert isinstance(answer, dict) and (answer["ready"], answer["wanted"]) == (1, 1)


def test_unpaused_a_run_has_what_it_had_before(house: House, run: Run, wait_until: Callable[..., None]) -> None:
    for ask, state, workers in (
        (requests.pause, "PAUSED", 0),
        (requests.pause, "PAUSED", 0),  # a second one forgets nothing
        (requests.unpause, "RUNNING", 2),
    ):
        answer = until_told(house, Asking(lambda ask=ask: ask(run, LONG_S)), wait_until)  # type: ignore[misc]
        assert isinstance(answer, dict) and (answer["state"], answer["ready"]) == (state, workers)
    with pytest.raises(RunError, match=r"is not paused \(RUNNING\)"):
        requests.unpause(run)


def test_unpaused_a_run_that_scales_by_itself_does_so_again() -> None:
    house = House(2, 40, autoscale=(2, 6))
    house.pool.tick()
    house.scale(0)
    house.pool.tick()
    assert (house.pool.state.wanted, house.pool.state.autoscale) == (0, None)
    house.asker.requests.append(UnpauseRequested())
    house.until(lambda: house.ready == 6, 10)
    assert house.pool.state.autoscale == (2, 6)


def test_scaled_by_hand_a_paused_run_forgets_what_it_had() -> None:
    house = House(4)
    for workers in (0, 1):
        house.scale(workers)
        house.pool.tick()
    house.asker.requests.append(UnpauseRequested())
    house.pool.tick()
    assert house.pool.state.wanted == 1


def test_a_stop_waits_for_the_end_and_nothing_can_be_asked_meanwhile(
    tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    run = catalog.create(tmp_path, "stopped", "{}")
    with catalog.locked(run):
        house = House(2, outside=Desk(run, 8))
        house.until(lambda: house.ready == 2, 5)
        asking = Asking(lambda: requests.stop(run, LONG_S))
        wait_until(asked_for(run, What.STOP), 60)
        house.run(2.0)
        with pytest.raises(RunError, match="is being stopped"):
            requests.scale(run, 1)
        assert asking.is_alive()
        house.pool.close(RunState.STOPPING, "asked for")
    asking.join(LONG_S)
    assert asking.answer == "STOPPED; --resume continues it"
    assert events.read(run)[-1]["reason"] == "asked for"


def test_a_run_that_does_not_stop_by_the_deadline_is_named_with_its_process(run: Run) -> None:
    with pytest.raises(RunError, match=r"asked was asked to stop, and its process \d+ has not done so within 0 s"):
        requests.stop(run, 0.0)


def test_what_nobody_runs_cannot_be_asked_for_anything(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "still", "{}")
    with pytest.raises(RunError, match="still is not running"):
        requests.stop(run)
    with pytest.raises(RunError, match="has no status"):
        requests.scale(run, 1)
    assert not run.request.exists()


def test_what_was_asked_of_a_process_is_forgotten_when_the_next_one_has_the_run(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "resumed", "{}")
    with catalog.locked(run), pytest.raises(RunError, match="0 s"):
        requests.stop(run, 0.0)
    assert run.request.exists()
    with catalog.locked(run):
        assert Inbox(run).new() is None


def test_each_request_comes_once_and_a_damaged_one_is_told_of(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    inbox = Inbox(run)
    durable.replace(run.request, json.dumps({"id": "1", "what": "workers", "workers": 3}).encode())
    assert str(inbox.new()) == "for 3 workers"
    assert inbox.new() is None
    durable.replace(run.request, b'{"id": "2"}')
    assert inbox.new() is None
    assert "cannot read" in caplog.text and "request.json" in caplog.text


def test_files_that_many_replace_at_once_are_whole(tmp_path: Path) -> None:
    path = tmp_path / "asked"
    contents = [bytes([65 + number]) * 5000 for number in range(8)]

    def replace(content: bytes) -> None:
        for _ in range(20):
            durable.replace(path, content)

    threads = [threading.Thread(target=replace, args=[content]) for content in contents]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert not path.exists() or path.read_bytes() in contents
    assert path.read_bytes() in contents
    assert list(tmp_path.iterdir()) == [path]


@contextmanager
def unwritable(folder: Path) -> Iterator[None]:
    """Nobody may write in a folder and what is in it meanwhile, root aside."""
    paths = [folder, *folder.rglob("*")]
    modes = [path.stat().st_mode for path in paths]
    for path in paths:
        path.chmod(0o555 if path.is_dir() else 0o444)
    try:
        yield
    finally:
        for path, mode in zip(paths, modes, strict=True):
            path.chmod(mode)


def test_status_and_events_are_read_without_permission_to_write_and_leave_no_trace(house: House, run: Run) -> None:
    house.run(2.0)
    with unwritable(run.path):
        before = {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}
        assert status.status(run)["ready"] == 2
        assert [event["event"] for event in events.read(run)] == ["start", "running"]
        assert {path: path.stat().st_mtime_ns for path in run.path.rglob("*")} == before
