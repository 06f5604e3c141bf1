"""The first hour: what it asks of a trained run is answered, and its link leads to the moment that it draws."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.storage import catalog

BLOCK = re.compile(r"^```console\n(.*?)^```", re.MULTILINE | re.DOTALL)
MOMENT = re.compile(r"t6gps render rough-quick (\d+) --step (\d+)")
READING = ("query", "schema", "show", "render", "events")
"""Commands of the page that read a run that is there."""


def test_what_the_page_asks_of_a_run_is_answered(
    pages: dict[str, str], tiny: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog.copy(tiny.run, tmp_path / "runs", "rough-quick")
    monkeypatch.chdir(tmp_path)
    page = pages["docs/tutorial.md"]
    moment = MOMENT.search(page)
    assert moment is not None
    lines = [shlex.split(line)[1:] for block in BLOCK.findall(page) for line in block.splitlines()]
    asked = [line for line in lines if line and line[0] in READING]
    assert {line[0] for line in asked} == set(READING)
    for line in asked:
        t6gps(*("4" if word == moment[1] else "20" if word == moment[2] else word for word in line))
    assert (tmp_path / "stuck.png").stat().st_size > 0
    assert (tmp_path / "stuck.mp4").stat().st_size > 0


def test_the_link_leads_to_the_moment_that_is_drawn(pages: dict[str, str]) -> None:
    page = pages["docs/tutorial.md"]
    moment = MOMENT.search(page)
    assert moment is not None
    assert f"#/replay?run=rough-quick&episode={moment[1]}&step={moment[2]}" in page
    assert f"| {moment[1]} | {moment[2]} |" in page
