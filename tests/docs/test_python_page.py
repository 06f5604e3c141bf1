"""Laws of the page for Python: it names what there is, and its code runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import t6gps

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
ROW = re.compile(r"^\| `t6gps\.(\w+)` \|", re.MULTILINE)
USE = re.compile(r"\bt6gps\.(\w+)")


def test_the_page_names_exactly_what_there_is(pages: dict[str, str]) -> None:
    assert sorted(ROW.findall(pages["docs/python.md"])) == sorted(t6gps.__all__)


def test_the_page_shows_each_name_in_use(pages: dict[str, str]) -> None:
    assert set(USE.findall("".join(BLOCK.findall(pages["docs/python.md"])))) == set(t6gps.__all__)


def test_the_readme_shows_names_that_there_are(pages: dict[str, str]) -> None:
    (block,) = BLOCK.findall(pages["README.md"])
    assert set(USE.findall(block)) <= set(t6gps.__all__)
    assert len(block.strip().splitlines()) <= 6
    compile(block, "README.md", "exec")


@pytest.mark.slow
def test_the_code_of_the_page_runs_from_top_to_bottom(pages: dict[str, str], tmp_path: Path) -> None:
    code = tmp_path / "page.py"
    code.write_text("\n".join(BLOCK.findall(pages["docs/python.md"])))
    done = subprocess.run([sys.executable, code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "QueryError" in done.stdout
