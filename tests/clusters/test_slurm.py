"""Laws of jobs on a real Slurm of two nodes: a run has the same bytes whatever happens to its job; nothing is left."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import run_digest
import slurm_cluster
import tiny_run
from command import t6gps
from slurm_cluster import Cluster, wait_until

from t6gps.service.steering import requests
from t6gps.storage import catalog, checkpoint

pytestmark = [
    pytest.mark.slow,
    pytest.mark.ray,
    pytest.mark.skipif(
        bool(slurm_cluster.missing()) or os.geteuid() != 0,
        reason=f"a Slurm of its own needs root and the programs {', '.join(slurm_cluster.PROGRAMS)}",
    ),
]

LONG = [*tiny_run.settings(), *tiny_run.VALUED, "--set=run.iterations=20"]
"""Long enough that a job can be interrupted after a checkpoint, and again after another one."""
ENDS_S = 600.0


@dataclass(frozen=True)
class Desk:
    """Where somebody submits from: a cluster, a root that its nodes share, and a folder of states."""

    cluster: Cluster
    folder: Path

    @property
    def root(self) -> Path:
        return self.folder / "runs"

    def t6gps(self, *arguments: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
        """Run a command on the cluster, and see that it ends with `code`."""
        state = f"T6GPS_STATE={self.folder / 'state'}"
        done = self.cluster.call(
            "env", state, sys.executable, "-m", "t6gps", *map(str, arguments), "--root", str(self.root)
        )
        assert done.returncode == code, done.stderr + done.stdout
        return done

    def submit(self, run: str, *arguments: str, nodes: int = 2, cpus: int = 1, code: int = 0) -> str:
        """Submit a run on as many nodes and CPUs of each; what is printed, errors included."""
        target = self.folder / "targets.toml"
        target.write_text(f"[slurm]\npartition = 'all'\nnodes = {nodes}\ncpus_per_node = {cpus}\n")
        options = ["--to", "slurm", "--target", target, "--run", run, *arguments]
        done = self.t6gps("submit", "flat-quick", *options, code=code)
        return done.stdout + " ".join(done.stderr.split())

    def job(self, run: str) -> dict[str, str]:
        """The record of a run's job."""
        return json.loads((self.folder / "state" / "jobs" / f"{run}.json").read_text())

    def number(self, run: str) -> str:
        return self.job(run)["native_id"]

    def state(self, run: str) -> str:
        return json.loads(self.t6gps("status", run, "--json").stdout)["job"]["state"]

    def learned(self, run: str) -> int:
        """Iterations that a run's newest checkpoint holds, 0 without one."""
        return max(checkpoint.kept(self.root / run / "checkpoints"), default=0)

    def ended(self, run: str) -> str:
        """Wait until a job has ended and nothing of it runs; how it ended."""
        wait_until(lambda: not self.cluster.asked("squeue", "-h"), ENDS_S)
        wait_until(lambda: not self.cluster.of_jobs(), ENDS_S)
        return self.state(run)

    def digests(self, run: str) -> dict[str, str]:
        return run_digest.digests(self.root / run)


@pytest.fixture(scope="module")
def desk() -> Iterator[Desk]:
    folder = Path(tempfile.mkdtemp(prefix="t6gps-"))
    try:
        with slurm_cluster.started(folder / "slurm") as cluster:
            yield Desk(cluster, folder)
    finally:
        shutil.rmtree(folder)


@pytest.fixture(autouse=True)
def no_job_left(desk: Desk) -> Iterator[None]:
    """The jobs of a test end with it, also where it fails."""
    yield
    desk.cluster.asked("scancel", "--full", "--user=root")
    wait_until(lambda: not desk.cluster.of_jobs(), ENDS_S)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of the run of LONG, trained in one process."""
    root = tmp_path_factory.mktemp("expected")
    t6gps("train", "flat-quick", "--run", "serial", "--serial", "--root", root, *LONG)
    return run_digest.digests(root / "serial")


def requeue(desk: Desk, run: str) -> None:
    desk.cluster.asked("scontrol", "requeue", desk.number(run))


def fail_node(desk: Desk, run: str) -> None:
    """Set the second node down; it comes back when the job has lost it."""
    desk.cluster.asked("scontrol", "update", "nodename=t6n2", "state=down", "reason=test")
    wait_until(lambda: not running(desk, run), ENDS_S)
    wait_until(lambda: serves_again(desk), ENDS_S)


def serves_again(desk: Desk) -> bool:
    """Ask for the second node to serve again; True when it does. Asking is refused where it has come back by itself."""
    desk.cluster.call("scontrol", "update", "nodename=t6n2", "state=resume")
    return "State=DOWN" not in desk.cluster.asked("scontrol", "-o", "show", "node", "t6n2")


def running(desk: Desk, run: str) -> bool:
    return "RUNNING" in desk.cluster.asked("squeue", "-h", "-o", "%T", "-j", desk.number(run))


def learns_more(desk: Desk, run: str) -> None:
    """Wait until a run has a checkpoint that it did not have."""
    before = desk.learned(run)
    wait_until(lambda: desk.learned(run) > before, ENDS_S)


def test_a_job_on_two_nodes_that_is_requeued_loses_a_node_and_is_stopped_resumes_to_the_same_bytes(
    desk: Desk, expected: dict[str, str]
) -> None:
    desk.submit("long", *LONG)
    number = desk.number("long")
    for restarts_n, interrupt in enumerate((requeue, fail_node), start=1):
        learns_more(desk, "long")
        interrupt(desk, "long")
        wait_until(lambda: "PENDING" in desk.cluster.asked("squeue", "-h", "-o", "%T", "-j", number), ENDS_S)
        wait_until(lambda: not desk.cluster.of_jobs(), ENDS_S)
        assert desk.state("long") == "pending"
        desk.cluster.asked("scontrol", "update", f"jobid={number}", "StartTime=now")  # Slurm would wait for two minutes
        wait_until(lambda: running(desk, "long"), ENDS_S)
        assert f"Restarts={restarts_n}" in desk.cluster.asked("scontrol", "show", "job", number)
    learns_more(desk, "long")
    requests.pause(catalog.open_run(desk.root, "long"), ENDS_S)  # so that it does not end meanwhile
    assert "job long is stopped" in desk.t6gps("stop", "long").stdout
    assert desk.ended("long") == "stopped"
    assert "everything sampled so far is kept" in desk.t6gps("logs", "long").stdout
    desk.submit("long", *LONG, "--resume")
    assert desk.ended("long") == "done"
    assert desk.digests("long") == expected


def test_jobs_of_an_array_share_a_node_and_each_trains_its_seed(desk: Desk) -> None:
    desk.submit("array", *tiny_run.settings(), "--seeds", "2", "--workers", "1", nodes=1)
    runs = ["array-seed0", "array-seed1"]
    number = desk.number(runs[0]).partition("_")[0]
    assert [desk.number(run) for run in runs] == [f"{number}_0", f"{number}_1"]
    wait_until(lambda: all((desk.root / run).is_dir() for run in runs), ENDS_S)
    assert desk.cluster.asked("squeue", "-h", "-o", "%N", "-j", number).split() == ["t6n1", "t6n1"]
    assert [desk.ended(run) for run in runs] == ["done", "done"]
    seeds = [json.loads((desk.root / run / "config.json").read_text())["run"]["seed"] for run in runs]
    assert seeds == [0, 1]
    assert all("iteration 2" in desk.t6gps("logs", run).stdout for run in runs)


def test_a_job_that_waits_is_in_the_way_of_another_and_stops_before_it_starts(desk: Desk) -> None:
    log = desk.folder / "other.log"
    other = desk.cluster.asked("sbatch", "--parsable", "-N2", "-c2", f"--output={log}", "--wrap=sleep 600").strip()
    desk.submit("waiting", *tiny_run.settings())
    assert desk.state("waiting") == "pending"
    refused = desk.submit("waiting", *tiny_run.settings(), "--resume", code=2)
    assert "job waiting is pending" in refused
    assert "job waiting is stopped" in desk.t6gps("stop", "waiting").stdout
    desk.cluster.asked("scancel", other)
    assert desk.ended("waiting") == "stopped"
    assert not (desk.root / "waiting").exists()


def test_a_job_that_is_cancelled_leaves_nothing_running(desk: Desk) -> None:
    desk.submit("cancelled", *LONG)
    wait_until(lambda: desk.learned("cancelled"), ENDS_S)
    desk.cluster.asked("scancel", desk.number("cancelled"))
    assert desk.ended("cancelled") in ("failed", "stopped")


@pytest.mark.parametrize(
    ("nodes", "arguments", "words"),
    [
        (3, [], ["sbatch", "node", "correct the file of targets"]),
        (1, ["--workers", "2"], ["2 workers", "do not fit", "allowed: 1", "--workers"]),
    ],
)
def test_what_the_cluster_does_not_have_is_refused_and_nothing_is_left(
    desk: Desk, nodes: int, arguments: list[str], words: list[str]
) -> None:
    said = desk.submit("refused", *tiny_run.settings(), *arguments, nodes=nodes, code=2)
    assert all(word in said for word in words), said
    assert not desk.cluster.asked("squeue", "-h")
    assert not (desk.root / ".jobs" / "refused").exists()
    assert not (desk.folder / "state" / "jobs" / "refused.json").exists()


def test_a_job_whose_programs_are_not_on_the_node_says_so(desk: Desk) -> None:
    target = desk.folder / "elsewhere.toml"
    target.write_text("[slurm]\nbin = '/opt/elsewhere'\ncpus_per_node = 2\n")
    desk.t6gps("submit", "flat-quick", "--to", "slurm", "--target", target, "--run", "elsewhere")
    assert desk.ended("elsewhere") == "failed"
    status = desk.t6gps("status", "elsewhere").stdout
    assert "/opt/elsewhere has no programs t6gps and ray; set slurm.bin" in status
