"""Laws of the lines that a run on Ray writes: each is an object, and trouble carries the slot and the episode."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from house import House, joining, pid

from t6gps.service import logs
from t6gps.service.logs import Format, Role, Speaker
from t6gps.service.pool.ledger import FAILURES_ALLOWED_N
from t6gps.service.ray_backend import private, processes
from t6gps.storage.records import Episode


@pytest.fixture
def house(ray_head: dict[str, str], tmp_path: Path) -> Iterator[House]:
    """Two workers of a run `walk` whose lines are objects."""
    logs.begin(Speaker(Format.JSON, Role.SUPERVISOR, "walk"))
    try:
        with joining(ray_head):
            house = House(tmp_path)
        yield house
        house.executor.close()
    finally:
        logs.begin(Speaker())


def objects(text: str) -> list[dict[str, Any]]:
    """The objects of a log; Ray writes lines of its own, with a colon first, between those of a worker."""
    found = [line for line in text.splitlines() if line and not line.startswith(":")]
    return [json.loads(line) for line in found]


def test_trouble_is_told_with_its_slot_and_its_episode_by_worker_and_supervisor(
    house: House, capsys: pytest.CaptureFixture[str]
) -> None:
    raising = house.order(3, "raise")
    house.check(house.sample(), without=(raising,))
    slots = {worker.id.slot: pid(worker) for worker in house.workers}
    of_workers = {slot: objects(processes.log_tail(private.logs_folder(), process)) for slot, process in slots.items()}
    failed = [(slot, line) for slot, lines in of_workers.items() for line in lines if line.get("episode") == raising]
    assert len(failed) == FAILURES_ALLOWED_N
    for slot, line in failed:
        assert (line["level"], line["run"], line["role"], line["slot"]) == ("error", "walk", "worker", slot)

    exiting, counters = house.order(8, "exit"), house.executor.pool.state.counters

    def relent(sampled: list[Episode]) -> None:
        if counters["crashed"]:
            (house.orders / f"episode-{exiting}").unlink(missing_ok=True)

    house.check(house.sample(relent))
    said = [line for line in objects(capsys.readouterr().err) if line["logger"].startswith("t6gps")]
    assert {(line["run"], line["role"]) for line in said} == {("walk", "supervisor")}
    for episode in (raising, exiting):
        told = [line for line in said if line.get("episode") == episode and "slot" in line]
        assert told
        assert {line["level"] for line in told} == {"warning"}
    assert {line["episode"] for line in said if "quarantine" in line["message"]} == {raising}
