"""Laws of the decision log: what was decided is decided again from it, and it stays small."""

from __future__ import annotations

from pathlib import Path

import pytest
from paper import House

from t6gps.service.pool.decision_log import DecisionLog, replay
from t6gps.storage.errors import RunError


def test_what_was_decided_under_faults_is_decided_again_from_the_log(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path)
    house = House(2, 60, log=log)
    house.paper.hanging.add(7)
    house.paper.crashing.add(11)
    house.paper.raising.add(13)

    def disturb(found: list[int]) -> None:
        if len(found) == 20:
            house.scale(4)
        if len(found) == 40:
            house.paper.die(next(iter(house.paper.alive)))

    assert sorted(house.sample(disturb)) == [number for number in range(60) if number not in (7, 11, 13)]
    log.close()
    assert replay(tmp_path / "decisions.jsonl") > 100


def test_a_recorded_failure_is_decided_again() -> None:
    """Real workers were killed, hung and failed (tests/faults/record.py); today's supervisor decides the same."""
    recorded = Path(__file__).with_name("recorded_failure.jsonl")
    assert replay(recorded) > 50
    text = recorded.read_text()
    for sign in (
        '"why":"hung"',
        '"why":"crashed"',
        '"episode_at_fault":false',
        '"kind":"raised"',
        '"kind":"Quarantine"',
    ):
        assert sign in text


def test_a_log_that_has_grown_large_begins_anew_with_the_state_and_is_replayed_from_there(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path, largest_bytes=20_000)
    house = House(2, 60, autoscale=(1, 3), log=log)
    house.paper.crashing.add(11)
    assert len(house.sample()) == 59
    log.close()
    for name in ("decisions.jsonl", "decisions.1.jsonl"):
        assert replay(tmp_path / name) > 0
        assert (tmp_path / name).stat().st_size < 30_000


def test_a_log_whose_state_is_larger_than_its_limit_is_a_log_all_the_same(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path, largest_bytes=100)
    House(2, 60, log=log).sample()
    log.close()
    assert replay(tmp_path / "decisions.1.jsonl") > 10


def test_what_a_process_said_may_hold_any_character(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path)
    house = House(2, 10, log=log)

    def kill(found: list[int]) -> None:
        if len(found) == 1:
            house.paper.die(next(iter(house.paper.alive)), "Ended\u2028badly\x85")

    house.sample(kill)
    log.close()
    assert replay(tmp_path / "decisions.jsonl") > 10


def test_a_log_of_which_a_line_was_changed_is_not_replayed(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path)
    house = House(2, 10, log=log)
    house.sample()
    log.close()
    path = tmp_path / "decisions.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:5] + [lines[5].replace('"episode_id":0', '"episode_id":9')] + lines[6:]))
    with pytest.raises(RunError, match="line 6 is decided otherwise"):
        replay(path)
    path.write_text("\n".join(lines[:5] + [lines[5][:20]]))
    with pytest.raises(RunError, match="line 6 is no round of a decision log"):
        replay(path)
