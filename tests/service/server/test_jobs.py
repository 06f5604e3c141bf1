"""Laws of runs at work in the background: started, stopped and resumed over HTTP, they keep what they sample."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from loopback import listening

from t6gps.service.api.policy import Policy
from t6gps.service.remote.client import Client
from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app, tokens
from t6gps.service.server.guard import utc_now
from t6gps.service.training import policies
from t6gps.storage import catalog, tables
from t6gps.storage.errors import ConfigError, RunError

SETTINGS = {"run.iterations": 1, "run.episodes": 40, "run.steps": 250, "run.evaluation_episodes": 2, "run.workers": 1}


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    """The client of a server that starts real processes."""
    root = tmp_path / "runs"
    token = tokens.issue(root, TokenRequest(name="me", scope=Scope.OPERATE, days=1.0), utc_now()).token
    with listening(app.create(root)) as url, Client(url, token) as client:
        yield client


@pytest.mark.slow
@pytest.mark.ray
def test_a_run_is_started_scaled_stopped_and_resumed_from_afar(
    client: Client, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    root = tmp_path / "runs"
    assert client.start("flat-quick", "far", SETTINGS).name == "far"
    run = catalog.open_run(root, "far")

    def sampled() -> bool:
        return len(list(run.spool.glob("iteration-*/episode-*.arrow"))) >= 2

    try:
        wait_until(sampled, 240)
        with pytest.raises(RunError, match="is not paused"):
            client.resume("far")
        assert client.pause("far")["ready"] == 0
        assert client.resume("far").pid == catalog.process_of(run)
        assert client.status("far")["ready"] == 1
    finally:
        client.stop("far")
    assert catalog.process_of(run) is None
    kept = len(list(run.spool.glob("iteration-*/episode-*.arrow")))
    assert 2 <= kept < 40
    with pytest.raises(RunError, match="not running"):
        client.stop("far")
    client.resume("far")
    log = root / ".server" / "logs" / "far.log"
    wait_until(lambda: "is complete" in log.read_text(), 300)
    assert catalog.process_of(run) is None
    assert client.evaluation("far") is not None
    assert tables.read(run, "episodes").num_rows == 40
    assert client.versions("far") == [0, 1]
    assert client.figures("far") == ["ground_track.png", "learning.png", "segments.png"]


@pytest.mark.parametrize(
    ("preset", "name", "settings", "words"),
    [
        ("none", None, {}, "allowed: flat"),
        ("/etc/passwd", None, {}, "allowed: flat"),
        ("flat-quick", None, {"terrain.file": "/etc/passwd"}, "out of reach"),
        ("flat-quick", None, {"run.iteration": 1}, "run.iteration"),
        ("flat-quick", None, {"run.iterations": "many"}, "run.iterations"),
        ("flat-quick", None, {"run.iterations": 0}, "run.iterations"),
    ],
)
def test_what_cannot_be_started_leaves_nothing(
    client: Client, tmp_path: Path, preset: str, name: str | None, settings: dict[str, object], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        client.start(preset, name, settings)
    assert not catalog.list_runs(tmp_path / "runs")


def test_a_policy_from_afar_acts_as_the_one_here(tiny: tiny_run.Trained, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    catalog.copy(tiny.run, root, "tiny")
    token = tokens.issue(root, TokenRequest(name="me", scope=Scope.READ, days=1.0), utc_now()).token
    observation = np.linspace(-1.0, 1.0, 83)
    with listening(app.create(root)) as url, Client(url, token) as client:
        version = client.versions("tiny")[-1]
        there = client.policy("tiny", version)
        assert client.figure("tiny", client.figures("tiny")[0]).startswith(b"\x89PNG")
        assert [row["iteration"] for row in client.metrics("tiny")] == [0, 1, 2]
        assert client.evaluation("tiny") is not None
        with pytest.raises(Exception, match="no policy of version"):
            client.policy("tiny", 99)
    here = Policy(policies.load(tiny.run, version))
    assert (there(observation) == here(observation)).all()
