"""Laws of joining a cluster: an address that cannot be right is refused at once, in words."""

from __future__ import annotations

import socket
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


def test_an_address_at_which_nobody_listens_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
    with pytest.raises(RunError, match=f"no Ray that answers at 127.0.0.1:{port}"):
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
