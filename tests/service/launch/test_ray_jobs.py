"""Laws of submitting to a Ray cluster: what cannot be used is refused by its cause, before anything starts."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from command import t6gps

from t6gps.service import config as configuration
from t6gps.service import provenance
from t6gps.service.launch import job as records
from t6gps.service.launch.targets import ray_jobs
from t6gps.service.ray_backend.errands import Node, Survey
from t6gps.storage.errors import T6GpsError

needs_client = pytest.mark.usefixtures("client")
BUILD = provenance.build()
HEAD = Node(address="10.0.0.1", cpus=2, build=BUILD, sees_root=True)


@pytest.fixture
def client() -> None:
    """Ray's client for jobs."""
    pytest.importorskip("aiohttp", reason="jobs on Ray need pip install 't6gps[cluster]'")


@pytest.fixture(autouse=True)
def states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    monkeypatch.setenv("T6GPS_TARGET", str(tmp_path / "targets.toml"))
    monkeypatch.setenv("T6GPS_ROOT", str(tmp_path / "runs"))


@pytest.fixture
def answering() -> Iterator[list[str]]:
    """A server that is no Ray: what it answers to everything, and last its address."""
    said = ["", ""]

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(said[0].encode())

        def log_message(self, *_: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        said[1] = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield said
        server.shutdown()
        thread.join()


def refused(folder: Path, address: str) -> str:
    """How a submission to a cluster is refused; nothing is left of it."""
    (folder / "targets.toml").write_text(f"[ray]\naddress = '{address}'\n")
    done = t6gps("submit", "flat-quick", "--to", "ray", code=2)
    assert not records.jobs()
    assert not (folder / "runs").exists()
    return " ".join(done.stderr.split())


@needs_client
def test_an_address_at_which_nobody_listens_is_named(tmp_path: Path) -> None:
    said = refused(tmp_path, "http://127.0.0.1:1")
    assert "no Jobs API of Ray answers at http://127.0.0.1:1" in said
    assert "correct ray.address" in said


@needs_client
@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("<html>", "no Jobs API of Ray answers"),
        ("[]", "no Jobs API of Ray answers"),
        (json.dumps({"ray_version": "2.9.0"}), "has Ray 2.9.0, and this machine"),
    ],
)
def test_what_is_no_ray_or_another_one_is_refused(
    tmp_path: Path, answering: list[str], answer: str, words: str
) -> None:
    answering[0] = answer
    assert words in refused(tmp_path, answering[1])


def test_without_its_extra_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    assert "pip install 't6gps[cluster]'" in refused(tmp_path, "http://127.0.0.1:1")


def test_a_dry_run_prints_the_call_of_ray_and_asks_nobody(tmp_path: Path) -> None:
    (tmp_path / "targets.toml").write_text("[ray]\nroot = '/mnt/runs'\nbin = '/opt/t6gps/bin'\n")
    said = t6gps("submit", "flat-quick", "--to", "ray", "--run", "a", "--dry-run").stdout.decode()
    assert "PATH=/opt/t6gps/bin:$PATH bash /mnt/runs/.jobs/a/train.sh /mnt/runs/.jobs/a" in said
    assert "RAY_JOB_STOP_WAIT_TIME_S" in said
    assert list(tmp_path.iterdir()) == [tmp_path / "targets.toml"]


def other(**changed: object) -> Node:
    """A node beside the head, as it should be but for this."""
    return HEAD.model_copy(update={"address": "10.0.0.2", **changed})


@pytest.mark.parametrize(
    ("survey", "settings", "words"),
    [
        ((other(fault="No module named 't6gps'"),), [], ["node 10.0.0.2", "No module named", "install this version"]),
        ((other(fault="no answer within 60 s"),), [], ["node 10.0.0.2", "no answer", "mend or remove the node"]),
        (
            (other(build=BUILD | {"numpy": "1.0"}),), [],
            ["node 10.0.0.2", "numpy 1.0 (the head 10.0.0.1:", "install the same"],
        ),
        ((), ["run.workers=3"], ["3 workers", "1 nodes", "allowed: 2", "--autoscale 1:3"]),
        ((other(cpus=0.9),), ["run.workers=3"], ["2 nodes", "allowed: 2"]),
    ],
)  # fmt: skip
def test_a_cluster_that_does_not_suit_a_run_is_refused(
    survey: tuple[Node, ...], settings: list[str], words: list[str]
) -> None:
    config = configuration.load("flat-quick", settings)
    with pytest.raises(T6GpsError) as error:
        ray_jobs.judge(Survey(head=HEAD, others=survey, sees_file=True), config, "/mnt/runs")
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_head_with_another_t6gps_is_refused_and_another_library_on_this_machine_is_none_of_its_business() -> None:
    config = configuration.load("flat-quick")
    for name, suits in (("schema", False), ("t6gps", False), ("numpy", True), ("pybullet", True)):
        survey = Survey(head=HEAD.model_copy(update={"build": BUILD | {name: "0"}}), others=(), sees_file=True)
        if suits:
            ray_jobs.judge(survey, config, "/mnt/runs")
        else:
            with pytest.raises(T6GpsError, match=f"{name} 0 \\(this machine: "):
                ray_jobs.judge(survey, config, "/mnt/runs")


def test_a_run_that_scales_by_itself_may_ask_for_more_than_there_is() -> None:
    config = configuration.load("flat-quick", ["run.workers_min=1", "run.workers_max=9"])
    ray_jobs.judge(Survey(head=HEAD, others=(), sees_file=True), config, "/mnt/runs")
