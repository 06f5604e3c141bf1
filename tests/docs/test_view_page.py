"""Laws of the page on looking at episodes: its commands and its code run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.storage import catalog
from t6gps.workers.pictures.viewer import recording

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
ENTITY = re.compile(r"^    (\w+(?:/\w+)*)", re.MULTILINE)


def test_every_command_and_the_code_of_the_page_run(
    pages: dict[str, str], tiny: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog.copy(tiny.run, tmp_path / "runs", "rough")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("RERUN_CLI_PATH", "/bin/true")
    blocks = BLOCK.findall(pages["docs/view.md"])
    lines = [line for kind, block in blocks if kind == "console" for line in block.splitlines()]
    views = [line.split()[1:] for line in lines if line.startswith("t6gps view")]
    assert len(views) == 4
    for view in views:
        t6gps(*view)
    assert len(list((tmp_path / "episodes").iterdir())) == 6
    (code,) = (block for kind, block in blocks if kind == "python")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(json.loads(done.stdout.splitlines()[-1])) == 24, "the tensions of a step"


def test_the_page_lists_what_a_recording_holds(pages: dict[str, str]) -> None:
    named = set(re.findall(r"`([\w/]+)`", pages["docs/view.md"]))
    entities = set(ENTITY.findall(recording.__doc__ or ""))
    assert len(entities) == 12
    missing = {entity for entity in entities if entity not in named}
    assert not missing
