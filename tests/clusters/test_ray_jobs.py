"""Laws of jobs on a real Ray cluster with a token, an autoscaler, and a root that all see, or only its head."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import ray_cluster
import run_digest
import tiny_run
from command import t6gps
from ray_cluster import RayCluster
from ray_nodes import HEAD
from slurm_cluster import wait_until
from tiny_run import Trained

from t6gps.service.launch import job as records
from t6gps.service.launch import launchers
from t6gps.service.steering.status import Status

pytest.importorskip("aiohttp", reason="jobs on Ray need pip install 't6gps[cluster]'")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.ray,
    pytest.mark.skipif(
        bool(ray_cluster.missing()) or os.geteuid() != 0,
        reason=f"a Ray in a network of its own needs root and the programs {', '.join(ray_cluster.PROGRAMS)}",
    ),
]
ENDS_S = 300.0
ENDLESS = [*tiny_run.settings(), "--set=run.iterations=2000"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayCluster]:
    folder = Path(tempfile.mkdtemp(prefix="t6gps-"))
    try:
        with ray_cluster.started(folder / "ray") as cluster, cluster.inside():
            yield cluster
    finally:
        shutil.rmtree(folder)


@pytest.fixture(autouse=True)
def desk(cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Who submits has the token, and a folder of states; the jobs end with the test."""
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    monkeypatch.setenv("T6GPS_TARGET", str(tmp_path / "targets.toml"))
    monkeypatch.setenv("T6GPS_ROOT", str(tmp_path / "runs"))
    for name, value in cluster.environment.items():
        if name.startswith("RAY_"):
            monkeypatch.setenv(name, value)
    target(cluster, tmp_path)
    yield
    for job in records.jobs():
        launchers.serving(job).cancel(job)


def target(cluster: RayCluster, folder: Path, **settings: str) -> None:
    """Describe the cluster in the file of targets."""
    lines = [f"{name} = {json.dumps(value)}" for name, value in ({"address": cluster.url} | settings).items()]
    (folder / "targets.toml").write_text("\n".join(["[ray]", *lines]))


def submit(run: str, *arguments: str, code: int = 0) -> str:
    done = t6gps("submit", "flat-quick", "--to", "ray", "--run", run, *arguments, code=code)
    return " ".join(done.stderr.split())


def known(run: str) -> Status:
    return json.loads(t6gps("status", run, "--json").stdout)


def status_there(cluster: RayCluster, run: str) -> Status | None:
    """How a run is by its file, which the head alone sees; None while there is none."""
    file = cluster.at_head(cluster.folder / "split" / "runs" / run / "pool" / "status.json")
    return json.loads(file.read_text()) if file.exists() else None


def nodes_of(status: Status | None) -> set[str]:
    """Where workers are at work."""
    return {worker["node"] for worker in status["workers"] if worker["pid"]} if status else set()


def replaced(status: Status, pids: set[int | None]) -> bool:
    """True when two workers are at work, one of which is none of these processes."""
    return len(nodes_of(status)) == 2 and not {worker["pid"] for worker in status["workers"]} <= pids


def test_a_run_whose_root_the_head_alone_sees_gains_and_loses_nodes_and_loses_no_episode(
    cluster: RayCluster, tmp_path: Path
) -> None:
    target(cluster, tmp_path, root=str(cluster.folder / "split" / "runs"))
    submit("far", *ENDLESS, "--autoscale", "1:2")
    wait_until(lambda: len(nodes_of(status_there(cluster, "far"))) == 2, ENDS_S)
    (brought,) = cluster.nodes()
    assert nodes_of(known("far")) == {HEAD, brought}

    np.save(tmp_path / "hill.npy", np.linspace(0, 1, 81 * 81).reshape(81, 81))
    ground = f"--set=terrain.file={tmp_path / 'hill.npy'}"
    refused = submit("split", *tiny_run.settings(), ground, "--workers", "1", code=2)
    assert f"node {brought} does not see {cluster.folder}/split/runs" in refused

    pids = {worker["pid"] for worker in status_there(cluster, "far")["workers"]}
    cluster.lose(brought)
    wait_until(lambda: replaced(status_there(cluster, "far"), pids), ENDS_S)
    assert t6gps("scale", "far", "1").stdout.decode().startswith("run far has 1 workers")
    episodes = status_there(cluster, "far")["episodes"]
    assert episodes["committed"] > 0
    assert (episodes["quarantined"], episodes["duplicates"]) == (0, 0)

    assert "t6gps serve --root" in " ".join(t6gps("fetch", "far", "--to", tmp_path, code=2).stderr.split())
    assert "job far is stopped" in t6gps("stop", "far").stdout.decode()
    assert "everything sampled so far is kept" in t6gps("logs", "far").stdout.decode()
    wait_until(lambda: not cluster.nodes(), ENDS_S)
    (tmp_path / "state" / "jobs" / "far.json").unlink()
    shutil.rmtree(tmp_path / "runs")
    assert "far exists already on the cluster" in submit("far", *tiny_run.settings(), "--workers", "1", code=2)


def test_a_run_in_a_shared_root_has_the_bytes_of_one_process_and_comes_home(tiny: Trained, tmp_path: Path) -> None:
    submit("tiny", *tiny_run.settings(), "--workers", "1")
    assert "iteration 2" in t6gps("logs", "-f", "tiny").stdout.decode()
    assert json.loads(t6gps("status", "tiny", "--json").stdout)["job"]["state"] == "done"
    home = t6gps("fetch", "tiny", "--to", tmp_path / "home").stdout.decode().strip()
    assert run_digest.digests(Path(home)) == tiny.digests


def test_what_the_cluster_cannot_do_is_refused_and_nothing_is_left(cluster: RayCluster, tmp_path: Path) -> None:
    split = cluster.folder / "split" / "mine"
    said = submit("a", "--root", str(split), code=2)
    assert "is not the same folder on the cluster" in said and "ray.root" in said
    shutil.rmtree(split)
    said = submit("a", "--workers", "9", code=2)
    assert "9 workers" in said and "allowed: 1; lower --workers, or let an autoscaler" in said
    target(cluster, tmp_path, root="/proc/runs")
    assert "on the cluster" in (said := submit("a", code=2)) and "root: /proc" in said
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").write_text("#!/bin/sh\necho python: No module named t6gps; exit 1")
    (tmp_path / "bin" / "python").chmod(0o755)
    target(cluster, tmp_path, bin=str(tmp_path / "bin"))
    assert "No module named t6gps; install this version of t6gps on the cluster's nodes" in submit("a", code=2)
    assert not records.jobs()
    assert not any((tmp_path / "runs" / ".jobs").iterdir())


def test_a_wrong_token_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    assert "does not accept the token" in submit("a", code=2)
