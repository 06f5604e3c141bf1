"""Laws of the commands that steer a run: what cannot be asked is one error with exit code 2, events come as lines."""

from __future__ import annotations

import json
from pathlib import Path

from command import t6gps

from t6gps.service.steering.events import EventKind, EventLog, Happened
from t6gps.storage import catalog


def test_a_run_that_nobody_runs_can_be_asked_for_nothing(tmp_path: Path) -> None:
    catalog.create(tmp_path, "still", "{}")
    for command, words in (("stop", "is not running"), ("pause", "has no status"), ("unpause", "has no status")):
        assert words in t6gps(command, "still", "--root", tmp_path, code=2).stderr


def test_events_are_lines_for_people_and_an_object_for_programs(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "eventful", "{}")
    assert t6gps("events", "eventful", "--root", tmp_path).stdout == b""
    EventLog(run.pool).write([Happened(EventKind.HANG, "no result"), Happened(EventKind.START, "again")], "sampling")
    lines = t6gps("events", "eventful", "--root", tmp_path).stdout.decode().splitlines()
    assert [line.split()[1:] for line in lines] == [
        ["hang", "sampling:", "no", "result"],
        ["start", "sampling:", "again"],
    ]
    told = json.loads(t6gps("events", "eventful", "--root", tmp_path, "--json").stdout)
    assert [event["event"] for event in told["events"]] == ["hang", "start"]
