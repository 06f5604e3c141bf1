"""A server on the loopback address, as tests see it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import uvicorn

from t6gps.service.config import Config
from t6gps.service.remote.client import Client
from t6gps.service.remote.messages import Scope
from t6gps.service.server import serving
from t6gps.service.server.guard import Limits
from t6gps.storage import schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.records import Episode, Learned

PATIENT = Limits(requests=(1e6, 10**6), failures=(1e6, 10**6))


@dataclass
class Server:
    """A server, what it has launched, the tokens by scope, and a clock that tests turn."""

    url: str
    run: Run
    tokens: dict[Scope, str]
    launched: list[str] = field(default_factory=list)
    later: timedelta = timedelta()

    @property
    def root(self) -> Path:
        return self.run.path.parent

    def now(self) -> datetime:
        return datetime.now(UTC) + self.later

    def launch(self, run: Run, _: Config) -> str:
        self.launched.append(run.name)
        return run.name

    def http(self, scope: Scope | None = None) -> httpx.Client:
        """A bare client, with the token of a scope or none."""
        headers = {} if scope is None else {"Authorization": f"Bearer {self.tokens[scope]}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=60, trust_env=False)

    def client(self, scope: Scope) -> Client:
        return Client(self.url, self.tokens[scope])


def commit(run: Run, iteration: int, make_episode: Callable[..., Episode]) -> None:
    """Commit an iteration of one synthetic episode."""
    row: dict[str, object] = dict.fromkeys(schema.ITERATIONS.names, 0)
    row |= {"iteration": iteration, "cost": 0.5 + iteration}
    learned = Learned(row, [], schema.MODELS.empty_table(), [])
    iterations.commit(run, iteration, iter([make_episode(iteration, iteration)]), learned)


@contextmanager
def listening(application: object, stalled_s: float = serving.STALLED_S, port: int = 0) -> Iterator[str]:
    """Serve an application in a thread; its address."""
    with serving.listening(serving.Address(port=port), stalled_s) as listener:
        config = uvicorn.Config(application, lifespan="off", log_level="error", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(60)
