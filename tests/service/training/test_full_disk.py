"""A disk that is full in the middle of an iteration: the run stops with one error, and resumes to the same bytes."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
import run_digest
import tiny_run
from command import t6gps
from tiny_run import Trained

MOST_BYTES = {"spool": 30_000, "tables": 80_000}
"""No file may be larger: an episode of the spool takes 50 kB, the frames of an iteration twice that."""


@pytest.mark.slow
@pytest.mark.parametrize("full", MOST_BYTES)
def test_a_run_stops_at_a_full_disk_and_resumes_to_the_same_bytes(full: str, tiny: Trained, tmp_path: Path) -> None:
    train = ["train", "flat-quick", "--run", "tiny", "--serial", "--root", str(tmp_path), *tiny_run.settings()]
    limit = MOST_BYTES[full]
    done = subprocess.run(
        [sys.executable, "-m", "t6gps", *train],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {tmp_path / 'tiny'}: ")
    assert "File too large; a limit holds for the size of files: raise it" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    kept = list((tmp_path / "tiny" / "spool" / "iteration-000000").glob("episode-*.arrow"))
    assert len(kept) == (0 if full == "spool" else 3)
    assert not list((tmp_path / "tiny" / "tables").rglob("*.parquet")), "it is whole or not there"
    t6gps(*train, "--resume")
    assert run_digest.digests(tmp_path / "tiny") == tiny.digests
