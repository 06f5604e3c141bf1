"""`t6gps doctor` says what a run needs, what was found, and what helps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import t6gps

from t6gps.service import checks


def test_it_names_every_check_and_says_that_a_run_starts(tmp_path: Path) -> None:
    found = json.loads(t6gps("doctor", "--json", "--root", tmp_path).stdout)
    assert found["starts"] is True
    assert len(found["checks"]) == len(checks.ALL)
    assert all(check["found"] and check["needed"] for check in found["checks"])


def test_what_would_stop_a_start_is_named_with_its_remedy_and_exits_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "ray://head:10001")
    (tmp_path / "file").write_text("")
    done = t6gps("doctor", "--json", "--root", tmp_path / "file", code=2)
    found = json.loads(done.stdout)
    assert found["starts"] is False
    bad = {check["check"]: check["remedy"] for check in found["checks"] if check["stops"] and not check["good"]}
    assert set(bad) == {"root", "RAY_ADDRESS"}
    assert "without ray://" in bad["RAY_ADDRESS"]
    table = t6gps("doctor", "--root", tmp_path / "file", code=2).stdout.decode()
    assert "a run would not start: root, RAY_ADDRESS" in table
