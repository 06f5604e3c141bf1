"""The client of a server: runs from afar, with the errors that they would have here.

with Client("https://gps.example.org:8686") as client: client.status("rough")
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import BinaryIO, final
from urllib.parse import quote

import httpx
import numpy as np
import pyarrow as pa
from pydantic import JsonValue

from t6gps.service.api.policy import Policy
from t6gps.service.remote.connection import Connection, checked
from t6gps.service.remote.messages import (
    AuditLine,
    Health,
    IssuedToken,
    QueryForm,
    QueryRequest,
    ScaleRequest,
    Scope,
    Started,
    StartRequest,
    TokenLine,
    TokenRequest,
)
from t6gps.service.remote.stream import Update
from t6gps.service.steering.requests import SCALE_DEADLINE_S
from t6gps.service.steering.status import Status
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import Row, RunSummary
from t6gps.storage import catalog
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.sql.query import Head

TOKEN_VARIABLE = "T6GPS_TOKEN"


@final
class Client:
    """Runs of a server. Close it, or use it in `with`. Methods raise ServerError, and the errors of what they ask."""

    def __init__(self, url: str, token: str | None = None, transport: httpx.BaseTransport | None = None) -> None:
        token = os.environ.get(TOKEN_VARIABLE, "") if token is None else token
        self._server = Connection(url, token.strip(), transport)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self._server.close()

    def health(self) -> Health:
        """The server's version."""
        return self._server.get("/health", Health)

    def runs(self) -> list[RunSummary]:
        """All runs by name, damaged ones included."""
        return self._server.get("/runs", list[RunSummary])

    def start(self, preset: str, name: str | None = None, settings: Mapping[str, JsonValue] | None = None) -> Started:
        """Start a run of a preset on the server's machine; its process."""
        request = checked(StartRequest, preset=preset, name=name, settings=dict(settings or {}))
        return self._server.post("/runs", Started, request)

    def status(self, name: str) -> Status:
        """How a run is."""
        return self._server.get(f"{_run(name)}/status", Status)

    def scale(self, name: str, workers: int, deadline_s: float = SCALE_DEADLINE_S) -> Status:
        """Give a running run so many workers, and wait until it has them; its status then."""
        request = checked(ScaleRequest, workers=workers, deadline_s=deadline_s)
        return self._server.post(f"{_run(name)}/scale", Status, request)

    def pause(self, name: str) -> Status:
        """Take all workers from a running run; its status then."""
        return self._server.post(f"{_run(name)}/pause", Status)

    def resume(self, name: str) -> Started:
        """Give a paused run its workers, or a stopped run a process."""
        return self._server.post(f"{_run(name)}/resume", Started)

    def stop(self, name: str) -> None:
        """Stop a run, and wait until it has ended; everything sampled is kept."""
        self._server.ask("POST", f"{_run(name)}/stop")

    def metrics(self, name: str) -> list[Row]:
        """Rows of the table `iterations`."""
        return self._server.get(f"{_run(name)}/metrics", list[Row])

    def evaluation(self, name: str) -> Evaluation | None:
        """What the last policy did without noise; None before the training has ended."""
        return self._server.get(f"{_run(name)}/evaluation", Evaluation | None)  # type: ignore[arg-type]

    def figures(self, name: str) -> list[str]:
        """Names of a run's figures."""
        return self._server.get(f"{_run(name)}/figures", list[str])

    def figure(self, name: str, figure: str) -> bytes:
        """A figure as PNG."""
        return self._server.ask("GET", f"{_run(name)}/figures/{quote(figure, safe='')}")

    def versions(self, name: str) -> list[int]:
        """Versions of the policies that are kept."""
        return self._server.get(f"{_run(name)}/policies", list[int])

    def policy(self, name: str, version: int) -> Policy:
        """A policy that acts here."""
        content = self._server.ask("GET", f"{_run(name)}/policies/{int(version)}")
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                layers_n = sum(key.startswith("weight_") for key in arrays.files)
                layers = tuple((arrays[f"weight_{k}"], arrays[f"bias_{k}"]) for k in range(layers_n))
                return Policy(PolicySnapshot(version, layers, float(arrays["offset_m"]), float(arrays["scale_m"])))
        except (ValueError, KeyError, OSError) as error:
            raise self._server.nonsense(error) from None

    def query(self, name: str, sql: str) -> pa.Table:
        """The result of one SELECT."""
        sink = io.BytesIO()
        self.write(name, sql, QueryForm.ARROW, sink)
        try:
            return pa.ipc.open_stream(sink.getbuffer()).read_all()
        except pa.ArrowException as error:
            raise self._server.nonsense(error) from None

    def table(self, name: str, table: str) -> pa.Table:
        """A table of a run (docs/data.md)."""
        return self.query(name, f"SELECT * FROM {table} ORDER BY iteration")

    def write(self, name: str, sql: str, form: str, sink: BinaryIO) -> None:
        """Write the result of one SELECT as arrow (an IPC stream), csv or json."""
        for chunk in self._server.chunks(f"{_run(name)}/query", checked(QueryRequest, sql=sql, form=form)):
            sink.write(chunk)
        sink.flush()

    def head(self, name: str, sql: str) -> Head:
        """The first rows of the result of one SELECT, as texts for people."""
        return self._server.post(f"{_run(name)}/query", Head, checked(QueryRequest, sql=sql, form=QueryForm.HEAD))

    def events(self, name: str, last: int = -1) -> Iterator[Update]:
        """What happens to a run after the iteration `last`, until the connection ends. ServerError then."""
        return self._server.events(f"{_run(name)}/events", last)

    def tokens(self) -> list[TokenLine]:
        """All tokens."""
        return self._server.get("/tokens", list[TokenLine])

    def create_token(self, name: str, scope: Scope, days: float) -> IssuedToken:
        """A new token."""
        return self._server.post("/tokens", IssuedToken, checked(TokenRequest, name=name, scope=scope, days=days))

    def revoke_token(self, name: str) -> None:
        """Refuse a token from now on."""
        self._server.ask("DELETE", f"/tokens/{quote(name, safe='')}")

    def audit(self) -> list[AuditLine]:
        """The newest changes that somebody asked for."""
        return self._server.get("/audit", list[AuditLine])


def _run(name: str) -> str:
    """Where a run is. RunError for what can name none."""
    return f"/runs/{catalog.check_name(name)}"
