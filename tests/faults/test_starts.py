"""A start under some of the conditions of `starts.py`: a run trains, or one sentence says why, and nothing is left."""

from __future__ import annotations

from pathlib import Path

import pytest
from starts import CONDITIONS, WAYS, Condition, possible, start, stop


@pytest.mark.slow
@pytest.mark.parametrize("condition", [each for each in CONDITIONS if each.tested], ids=lambda each: each.name)
def test_a_start_trains_or_says_why_and_leaves_nothing(condition: Condition, tmp_path: Path) -> None:
    if not possible(condition):
        pytest.skip(f"this machine cannot make it: {condition.needs}")
    assert start(condition, tmp_path).wrong == ""


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_stop_while_ray_starts_is_heeded_and_leaves_nothing(way: str, tmp_path: Path) -> None:
    outcome = stop(way, "while Ray starts", tmp_path)
    assert (outcome.wrong, outcome.said) == ("", "ends, and leaves no run")
