"""Laws of jobs that a server starts: started, stopped and resumed over HTTP, their runs keep what they sample."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from command import t6gps
from loopback import listening

from t6gps.service.api.policy import Policy
from t6gps.service.launch import job as records
from t6gps.service.launch import launchers
from t6gps.service.launch.job import JobState
from t6gps.service.remote import following
from t6gps.service.remote.client import Client
from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app, tokens
from t6gps.service.server.guard import utc_now
from t6gps.service.training import policies
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError

SETTINGS = {"run.iterations": 1, "run.episodes": 40, "run.steps": 250, "run.evaluation_episodes": 2, "run.workers": 1}


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    """The client of a server that starts real jobs."""
    root = tmp_path / "runs"
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    token = tokens.issue(root, TokenRequest(name="me", scope=Scope.OPERATE, days=1.0), utc_now()).token
    with listening(app.create(root)) as url, Client(url, token) as client:
        monkeypatch.setenv("T6GPS_SERVER", url)  # which must not lead its jobs back
        monkeypatch.setenv("T6GPS_TOKEN", token)
        yield client
        for job in records.jobs():
            launchers.serving(job).cancel(job)


@pytest.mark.slow
def test_a_run_is_started_steered_stopped_and_resumed_from_afar(
    client: Client,
    ray_head: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wait_until: Callable[..., None],
) -> None:
    for name, value in ray_head.items():
        monkeypatch.setenv(name, value)

    def far(*arguments: str) -> str:
        """What a command says with T6GPS_SERVER and T6GPS_TOKEN."""
        return t6gps(*arguments).stdout.decode()

    train = ["train", "flat-quick", "--run", "far", *(f"--set={key}={value}" for key, value in SETTINGS.items())]
    assert "run far is at work" in far(*train)
    run = catalog.open_run(tmp_path / "runs", "far")
    try:
        wait_until(lambda: len(sampled(run)) >= 2, 240)
        assert "has 0 workers (PAUSED)" in far("pause", "far")
        assert "has 1 workers (RUNNING)" in far("unpause", "far")
        assert far("pause", "far") and client.resume("far").job is None
        assert "has 1 workers (RUNNING)" in far("scale", "far", "1")
        assert far("status", "far").startswith("job far on local")
    finally:
        said = far("stop", "far")
    assert said == "job far is stopped; --resume continues it\n"
    assert catalog.process_of(run) is None
    assert 2 <= len(sampled(run)) <= 40
    assert "everything sampled so far is kept" in far("logs", "far")
    reasons = [line.split(maxsplit=2)[1] for line in far("events", "far").splitlines()]
    assert reasons.count("paused") == 2 and reasons[-1] in ("stopping", "running")
    far(*train, "--resume")
    assert "is running" in t6gps(*train, "--resume", code=2).stderr
    assert "forward m/s" in far("logs", "-f", "far")
    assert [(job.run, job.state) for job in client.jobs()] == [("far", JobState.DONE)]
    assert client.evaluation("far") is not None
    assert tables.read(run, "episodes").num_rows == 40
    assert client.versions("far") == [0, 1]
    assert client.figures("far") == ["ground_track.png", "learning.png", "segments.png"]


def sampled(run: Run) -> list[Path]:
    """Episodes that are durable and not committed."""
    return list(run.spool.glob("iteration-*/episode-*.arrow"))


@pytest.mark.slow
def test_a_run_has_one_job_whose_end_is_told_and_leaves_no_zombie(
    client: Client, monkeypatch: pytest.MonkeyPatch, wait_until: Callable[..., None]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    client.start("flat-quick", "far", SETTINGS)

    def resume(_: int) -> str:
        with pytest.raises(RunError) as refused:
            client.start("flat-quick", "far", SETTINGS, resume=True)
        return str(refused.value)

    with ThreadPoolExecutor() as threads:
        assert all("is running" in sentence for sentence in threads.map(resume, range(6)))
    (job,) = client.jobs()
    assert "no Ray answers" in "".join(following.logs(client, "far", follow=True, look_s=0.1))
    ended = client.standing("far").job
    assert ended is not None and ended.state is JobState.FAILED
    assert "no Ray answers" in ended.detail
    pid = int(job.native_id.split(":")[1])
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), 240)


@pytest.mark.parametrize(
    ("preset", "name", "settings", "words"),
    [
        ("none", None, {}, "allowed: flat"),
        ("none.toml", None, {}, "cannot read"),
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
