"""Laws of jobs on this machine: they outlive whoever submitted them, stop cleanly, and their run has the same bytes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import run_digest
import tiny_run
from command import t6gps
from house import joining
from tiny_run import Trained

from t6gps.service.launch import job as records
from t6gps.service.launch import launchers
from t6gps.service.launch.job import ENDED, Job
from t6gps.service.ray_backend import processes
from t6gps.storage import catalog

pytestmark = [pytest.mark.slow, pytest.mark.ray]
LONG = [*tiny_run.settings(), "--set=run.iterations=2000"]
Wait = Callable[[Callable[[], bool], float], None]


@pytest.fixture(autouse=True)
def no_job_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder of states for a test; its jobs end with it."""
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    yield
    for job in records.jobs():
        launchers.serving(job).cancel(job)


def state(name: str, root: Path) -> dict[str, str]:
    return json.loads(t6gps("status", name, "--json", "--root", root).stdout)["job"]


def family(job: Job) -> list[int]:
    """The processes of a job."""
    pid = int(job.native_id.split(":")[1])
    return [pid, *processes.descendants(pid)]


def test_a_job_outlives_its_terminal_and_comes_home(
    tiny: Trained, tmp_path: Path, wait_until: Wait, ray_head: dict[str, str]
) -> None:
    root = tmp_path / "runs"
    command = [sys.executable, "-m", "t6gps", "submit", "flat-quick", "--run", "tiny", "--root", str(root)]
    shell = subprocess.Popen([*command, *tiny_run.settings()], env=os.environ | ray_head, start_new_session=True)
    assert shell.wait() == 0
    job = records.jobs()[0]
    pid = int(job.native_id.split(":")[1])
    assert os.getsid(pid) == pid  # no terminal is there that could hang up
    assert "iteration 2" in t6gps("logs", "-f", "tiny", "--root", root).stdout.decode()
    wait_until(lambda: state("tiny", root)["state"] in ENDED, 240.0)
    assert state("tiny", root)["state"] == "done"
    home = t6gps("fetch", "tiny", "--root", root, "--to", tmp_path / "home").stdout.decode().strip()
    assert run_digest.digests(Path(home)) == tiny.digests


def test_a_job_stops_cleanly_and_leaves_no_process(tmp_path: Path, wait_until: Wait) -> None:
    root = tmp_path / "runs"
    t6gps("submit", "flat-quick", "--run", "a", "--root", root, *LONG)
    job = records.jobs()[0]
    wait_until(lambda: any((root / "a" / "checkpoints").glob("*")), 240.0)
    refused = t6gps("submit", "flat-quick", "--run", "a", "--resume", "--root", root, *LONG, code=2).stderr
    assert "is in use by process" in refused
    assert t6gps("scale", "a", "1", "--root", root).stdout.decode().startswith("run a has 1 workers")
    members = family(job)
    assert len(members) > 3
    assert "is stopped; --resume continues it" in t6gps("stop", "a", "--root", root).stdout.decode()
    wait_until(lambda: not any(processes.started(pid) for pid in members), 240.0)
    assert "everything sampled so far is kept" in t6gps("logs", "a", "--root", root).stdout.decode()
    assert "there is nothing to stop" in t6gps("stop", "a", "--root", root, code=2).stderr.replace("\n", " ")


def test_a_job_that_is_killed_is_failed_and_resumes(
    tiny: Trained, tmp_path: Path, wait_until: Wait, ray_head: dict[str, str]
) -> None:
    root = tmp_path / "runs"
    t6gps("submit", "flat-quick", "--run", "tiny", "--root", root, *tiny_run.settings())
    job = records.jobs()[0]
    wait_until((root / "tiny").exists, 240.0)
    for pid in family(job):
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: state("tiny", root)["state"] in ENDED, 240.0)
    assert state("tiny", root)["detail"].startswith("ended without a word")
    wait_until(lambda: catalog.process_of(catalog.open_run(root, "tiny")) is None, 240.0)
    with joining(ray_head):
        t6gps("submit", "flat-quick", "--run", "tiny", "--resume", "--root", root, *tiny_run.settings())
    t6gps("logs", "-f", "tiny", "--root", root)
    assert state("tiny", root)["state"] == "done"
    assert run_digest.digests(root / "tiny") == tiny.digests


def test_a_job_that_cannot_train_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    t6gps("submit", "flat-quick", "--run", "a", "--root", tmp_path)
    t6gps("logs", "-f", "a", "--root", tmp_path)
    known = state("a", tmp_path)
    assert known["state"] == "failed"
    assert known["detail"].startswith("error: RAY_ADDRESS: no Ray answers")
