"""Conditions under which no run starts are refused with the sentence for that very cause; `starts.py` has them all."""

from __future__ import annotations

from pathlib import Path

import pytest
from starts import CONDITIONS, Condition, possible, start


@pytest.mark.slow
@pytest.mark.parametrize("condition", [each for each in CONDITIONS if each.quick], ids=lambda each: each.name)
def test_a_start_that_cannot_succeed_says_why_and_leaves_nothing(condition: Condition, tmp_path: Path) -> None:
    if not possible(condition):
        pytest.skip(f"this machine cannot make it: {condition.needs}")
    assert start(condition, tmp_path).wrong == ""
