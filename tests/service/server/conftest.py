"""A server on the loopback address with a run of synthetic data, and tokens of each scope."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import pytest
from loopback import PATIENT, Server, commit, listening

from t6gps.service import config as configuration
from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app, tokens
from t6gps.service.server.guard import Limits
from t6gps.service.server.serving import STALLED_S
from t6gps.storage import catalog
from t6gps.storage.records import Episode


@pytest.fixture
def serve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_episode: Callable[..., Episode]
) -> Iterator[Callable[..., Server]]:
    """serve(limits, stalled_s) starts a server of a root with the run `walk`, which has committed two iterations."""
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    with ExitStack() as stack:

        def start(limits: Limits = PATIENT, stalled_s: float = STALLED_S) -> Server:
            run = catalog.create(tmp_path / "runs", "walk", configuration.load("flat-quick").to_json())
            for iteration in range(2):
                commit(run, iteration, make_episode)
            requests = {scope: TokenRequest(name=scope.value, scope=scope, days=1.0) for scope in Scope}
            now = datetime.now(UTC)
            texts = {scope: tokens.issue(run.path.parent, asked, now).token for scope, asked in requests.items()}
            server = Server("", run, texts)
            application = app.create(server.root, start=server.launch, now=server.now, limits=limits)
            server.url = stack.enter_context(listening(application, stalled_s))
            return server

        yield start


@pytest.fixture
def server(serve: Callable[..., Server]) -> Server:
    """A server that is patient with tests."""
    return serve()
