"""Laws of a run's events: whatever happens to its workers is told once, with its reason, in a file that stays small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from paper import House

from t6gps.service.pool.messages import UnpauseRequested
from t6gps.service.steering import events
from t6gps.service.steering.events import EventKind, EventLog, Happened
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError


def told(house: House, kind: EventKind) -> list[str]:
    """Reasons of the events of a kind."""
    return [each.reason for each in house.asker.happened if each.event is kind]


def kept(tmp_path: Path) -> list[str]:
    """Reasons of the events of a run in that folder."""
    return [event["reason"] for event in events.read(Run(tmp_path))]


def test_a_run_in_which_nothing_goes_wrong_tells_its_start_and_that_it_runs() -> None:
    house = House(600)
    house.paper.room = 600
    house.until(lambda: house.ready == 600, 5)
    assert [each.event for each in house.asker.happened] == ["start", "running"]
    assert told(house, EventKind.START) == ["600 slots from 0 to 599: 600 wanted"]


def test_a_worker_that_fails_is_told_and_so_is_its_replacement_both_with_the_cause() -> None:
    house = House(2, 30)
    house.paper.hanging.add(7)
    house.paper.crashing.add(11)
    assert len(house.sample()) == 28
    for kind, cause in ((EventKind.HANG, "Hang: no result within"), (EventKind.CRASH, "the process ended")):
        assert len(told(house, kind)) == 3
        assert all(cause in reason for reason in told(house, kind))
    house.until(lambda: house.ready == 2, 40)
    replacements = told(house, EventKind.REPLACEMENT)
    assert len(replacements) == 6
    assert sum("no result within" in reason for reason in replacements) == 3
    assert sorted(reason.split()[1] for reason in told(house, EventKind.QUARANTINE)) == ["11", "7"]


def test_scaling_a_pause_and_its_end_are_told_with_both_numbers() -> None:
    house = House(2)
    house.until(lambda: house.ready == 2, 5)
    house.scale(3)
    house.until(lambda: house.ready == 3, 5)
    house.scale(0)
    house.until(lambda: not house.pool.state.workers, 5)
    house.asker.requests.append(UnpauseRequested())
    house.until(lambda: house.ready == 3, 5)
    assert told(house, EventKind.SCALE) == [
        "workers, from 2 to 3: asked for",
        "workers, from 3 to 0: a pause was asked for",
        "workers, from 0 to 3: the end of the pause was asked for",
    ]
    assert len(told(house, EventKind.PAUSED)) == 1


def test_autoscaling_is_told_as_such() -> None:
    house = House(1, 40, autoscale=(1, 4))
    house.sample()
    assert told(house, EventKind.SCALE)[0] == "workers, from 1 to 4: autoscaling, by backlog and room"


def test_a_run_that_waits_for_a_cpu_says_so_once() -> None:
    house = House(3)
    house.paper.room = 1
    house.run(60)
    (reason,) = told(house, EventKind.WAITING)
    assert "2 wait for a CPU" in reason


def test_events_of_a_resumed_run_follow_those_before(tmp_path: Path) -> None:
    for reason in ("first", "second"):
        EventLog(tmp_path / "pool").write([Happened(EventKind.SCALE, reason)], "sampling")
    assert kept(tmp_path) == ["first", "second"]


def test_the_file_stays_small_and_the_newest_events_are_kept(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "pool", largest_bytes=2000)
    for number in range(200):
        log.write([Happened(EventKind.SCALE, str(number))], "sampling")
    assert sum(path.stat().st_size for path in (tmp_path / "pool").iterdir()) <= 4000
    numbers = [int(reason) for reason in kept(tmp_path)]
    assert numbers == list(range(numbers[0], 200))
    assert len(numbers) >= 10
    assert [event["number"] for event in events.read(Run(tmp_path))] == numbers


def test_who_follows_a_run_is_told_each_event_once_also_of_a_run_that_is_resumed(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "pool", largest_bytes=2000)
    log.write([Happened(EventKind.START, str(number)) for number in range(3)], "sampling")
    followed, told = events.follow(Run(tmp_path), look_s=0.001), list[str]()
    for number in range(3, 100):
        told.append(next(followed)["reason"])
        if number == 50:
            log = EventLog(tmp_path / "pool", largest_bytes=2000)
        log.write([Happened(EventKind.SCALE, str(number))], "sampling")
    assert told == [str(number) for number in range(97)]


def test_a_line_that_was_cut_off_hides_no_other_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    EventLog(tmp_path / "pool").write([Happened(EventKind.SCALE, "whole")], "sampling")
    path = tmp_path / "pool" / "events.jsonl"
    whole = path.read_text()
    path.write_text(whole + whole[:20])
    assert kept(tmp_path) == ["whole"]
    EventLog(tmp_path / "pool").write([Happened(EventKind.SCALE, "after")], "sampling")
    assert kept(tmp_path) == ["whole", "after"]
    path.write_text("{\n" + whole)
    with pytest.raises(RunError, match=r"events.jsonl: line 1 is no event"):
        kept(tmp_path)


def test_each_event_has_its_time_in_utc(tmp_path: Path) -> None:
    EventLog(tmp_path / "pool").write([Happened(EventKind.HANG, "ä\u2028")], "evaluation")
    (line,) = (tmp_path / "pool" / "events.jsonl").read_bytes().splitlines()
    event = json.loads(line)
    assert event["time"].endswith("+00:00")
    assert (event["event"], event["phase"], event["reason"]) == ("hang", "evaluation", "ä\u2028")
