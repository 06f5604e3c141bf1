"""A small share of `make fuzz`: mutated files give ground or one TerrainError, in bounded time and memory."""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).with_name("fuzz.py")


@pytest.mark.slow
def test_mutated_files_give_ground_or_one_error_each() -> None:
    done = subprocess.run([sys.executable, str(FUZZ), "60"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" of 60 gave heights") == 4
    assert done.stderr == ""
