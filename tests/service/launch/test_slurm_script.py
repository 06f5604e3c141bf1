"""Laws of the script of a Slurm job on a node, with stand-ins for Slurm's programs and for Ray."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

import pytest

SCRIPT = resources.files("t6gps.deploy") / "slurm" / "train.sbatch"
PROGRAMS = {
    "srun": 'shift 3; SLURM_PROCID=0 exec "$@"',
    "scontrol": "echo NodeName=node NodeAddr=127.0.0.1 CPUs=1",
    "t6gps": "",
    "ray": """for option; do case $option in --temp-dir=*) files=${option#*=} ;; esac; done
echo >> "$FOLDER/starts"
[ "$FAILS_N" -ge 0 ] || exec sleep 600
[ "$(wc -l < "$FOLDER/starts")" -gt "$FAILS_N" ] || { echo "Exception: the node timed out during startup"; exit 1; }
echo 192.0.2.1:6379 > "$files/ray_current_cluster"
exec sleep 600""",
}


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder for the files of Ray, whose path is short enough for them."""
    folder = Path(tempfile.mkdtemp(prefix="t", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


def started(folder: Path, short: Path, fails_n: int) -> subprocess.Popen[str]:
    """A job whose Ray fails so often at first; below 0 it neither fails nor is it ever up."""
    for name in ("bin", "job"):
        (folder / name).mkdir()
    for name, text in PROGRAMS.items():
        (folder / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / "bin" / name).chmod(0o755)
    (folder / "job" / "train.sh").write_text("echo trains with $RAY_ADDRESS\n")
    slurm = {"JOB_ID": "7", "JOB_NUM_NODES": "1", "CPUS_PER_TASK": "1", "RESTART_COUNT": "0"}
    environment = {f"SLURM_{name}": value for name, value in slurm.items()} | {
        "SLURMD_NODENAME": "node", "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "TMPDIR": str(short), "FOLDER": str(folder), "FAILS_N": str(fails_n),
    }  # fmt: skip
    command = ["bash", str(SCRIPT), str(folder / "bin"), str(folder / "job")]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def starts_n(folder: Path) -> int:
    """How often Ray was started."""
    starts = folder / "starts"
    return len(starts.read_text().splitlines()) if starts.exists() else 0


def test_a_node_that_is_too_busy_to_start_ray_at_once_starts_it_again(tmp_path: Path, short: Path) -> None:
    job = started(tmp_path, short, fails_n=2)
    assert job.communicate(timeout=240)[0] == "trains with 192.0.2.1:6379\n"
    assert (job.returncode, starts_n(tmp_path)) == (0, 3)


def test_a_job_whose_ray_does_not_start_says_why_in_the_words_of_ray(tmp_path: Path, short: Path) -> None:
    job = started(tmp_path, short, fails_n=9)
    words = "error: node node: Ray could not be started: Exception: the node timed out during startup; see "
    assert job.communicate(timeout=240)[0].startswith(words)
    assert (job.returncode, starts_n(tmp_path)) == (2, 3)
    assert (tmp_path / "job" / "exit_code").read_text() == "2\n"


def test_a_stop_while_ray_starts_ends_it_and_starts_no_other(
    tmp_path: Path, short: Path, wait_until: Callable[..., None]
) -> None:
    job = started(tmp_path, short, fails_n=-1)
    wait_until(lambda: starts_n(tmp_path) == 1, 240)
    job.send_signal(signal.SIGTERM)
    job.communicate(timeout=240)
    assert (job.returncode, starts_n(tmp_path)) == (130, 1)
    assert (tmp_path / "job" / "exit_code").read_text() == "130\n"
    assert not any(short.iterdir())
