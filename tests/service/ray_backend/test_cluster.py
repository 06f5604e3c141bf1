"""Laws of joining a cluster: an address that cannot be right is refused at once, in words."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import ray

from t6gps.service.config import Config
from t6gps.service.ray_backend import cluster
from t6gps.service.training import session
from t6gps.service.views.terminal import ProgressDisplay
from t6gps.storage import catalog
from t6gps.storage.errors import RunError


def connect() -> None:
    with cluster.connection(Config()):
        pass


@pytest.mark.parametrize("address", ["head", "head:", ":6379", "head:ray", "ray://head:10001"])
def test_what_is_no_address_of_a_head_is_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(RunError, match=r"RAY_ADDRESS: .*; needed: HOST:PORT of a cluster's head, or auto"):
        connect()


def test_an_address_at_which_nobody_listens_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
    with pytest.raises(RunError, match=f"no Ray answers at RAY_ADDRESS=127.0.0.1:{port}"):
        connect()
    assert not ray.is_initialized()


def test_a_run_whose_cluster_is_not_there_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "head")
    run = catalog.create(tmp_path, "one", Config().to_json())
    with pytest.raises(RunError, match="RAY_ADDRESS"):
        session.complete(Config(), run, False, ProgressDisplay(1))
    assert list(tmp_path.iterdir()) == []


OTHER_VERSION = """
import sys
import ray
ray.__version__ = "2.0.0"
from t6gps.__main__ import main
sys.argv = ["t6gps", "train", "flat-quick", "--root", sys.argv[1]]
main()
"""


@pytest.mark.slow
def test_a_cluster_of_another_version_is_refused_with_both_versions(ray_head: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-c", OTHER_VERSION, str(tmp_path)]
    done = subprocess.run(command, env=os.environ | ray_head, check=False, capture_output=True, text=True, timeout=240)
    assert done.returncode == 2, done.stderr
    for words in ("Version mismatch", ray.__version__, "2.0.0", "install the same versions"):
        assert words in done.stderr
    assert list(tmp_path.iterdir()) == []
