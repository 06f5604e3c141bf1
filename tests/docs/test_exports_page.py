"""Every command and every block of Python of docs/exports.md works, one after the other, beside runs that it names."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.storage import catalog
from t6gps.storage.exports.dataset import FORMATS

PAGE = (Path(__file__).parents[2] / "docs" / "exports.md").read_text(encoding="utf-8")
COMMANDS = [
    shlex.split(line)
    for block in re.findall(r"^```console\n(.*?)^```", PAGE, re.M | re.S)
    for line in block.splitlines()
]
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)


def test_the_commands_and_the_code_of_the_page_work(
    tiny: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rough-0", "rough-1"):
        catalog.copy(tiny.run, tmp_path / "runs", name)
    monkeypatch.chdir(tmp_path)
    assert {command[2] for command in COMMANDS} == {*FORMATS, "mjcf"}
    for command in COMMANDS:
        t6gps(*command[1:])
    assert len(BLOCKS) == 2
    for block in BLOCKS:
        exec(compile(block, "exports.md", "exec"), {})
