"""The client of a server: runs from afar, with the errors that they would have here.

with Client("https://gps.example.org:8686") as client: client.status("rough")
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, final
from urllib.parse import quote, urlencode

import httpx
import numpy as np
import pyarrow as pa
from pydantic import JsonValue

from t6gps.service import config as configuration
from t6gps.service.api.asking import Parameter, Parameters, Warn
from t6gps.service.api.policy import Policy
from t6gps.service.launch.control import JobLine, Standing
from t6gps.service.launch.fetch import File
from t6gps.service.remote.administration import Administration
from t6gps.service.remote.connection import Connection, checked
from t6gps.service.remote.driving import Driving
from t6gps.service.remote.messages import (
    Health,
    QueryForm,
    QueryRequest,
    ScaleRequest,
    Started,
    StartRequest,
    Stopped,
    StopRequest,
    WaitRequest,
)
from t6gps.service.remote.stream import START, Update
from t6gps.service.steering.events import Event
from t6gps.service.steering.requests import SCALE_DEADLINE_S, STOP_DEADLINE_S
from t6gps.service.steering.status import Status
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import Row, RunSummary
from t6gps.service.views.replay import Replay
from t6gps.storage import catalog, schema
from t6gps.storage.errors import RunError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.sql.query import Head

TOKEN_VARIABLE = "T6GPS_TOKEN"


@final
class Client:
    """Runs of a server. Close it, or use it in `with`. Methods raise ServerError, and the errors of what they ask."""

    def __init__(self, url: str, token: str | None = None, transport: httpx.BaseTransport | None = None) -> None:
        token = os.environ.get(TOKEN_VARIABLE, "") if token is None else token
        self.server = Connection(url, token.strip(), transport)
        self.admin = Administration(self.server)
        self.drives = Driving(self.server)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self.server.close()

    def health(self) -> Health:
        """The server's version."""
        return self.server.get("/health", Health)

    def runs(self) -> list[RunSummary]:
        """All runs by name, damaged ones included."""
        return self.server.get("/runs", list[RunSummary])

    def start(
        self,
        source: str,
        name: str | None = None,
        settings: Mapping[str, JsonValue] | None = None,
        resume: bool = False,
    ) -> Started:
        """Let the server train a run of a preset, or of a TOML file of this machine; its job.

        resume   go on with the run of that name, with the same settings; start it where it is not there yet
        """
        known = source in configuration.presets()
        text = {"preset": source} if known else {"toml": configuration.load(source).to_toml()}
        more = {"default_name": Path(source).stem, "settings": dict(settings or {}), "resume": resume}
        return self.server.post("/runs", Started, checked(StartRequest, **text, name=name, **more))

    def status(self, name: str) -> Status:
        """How a run is."""
        return self.server.get(f"{_run(name)}/status", Status)

    def standing(self, name: str) -> Standing:
        """How a run is, and the job that trains it."""
        return self.server.get(f"{_run(name)}/standing", Standing)

    def jobs(self) -> list[JobLine]:
        """The jobs that train runs of the server."""
        return self.server.get("/jobs", list[JobLine])

    def log(self, name: str, after: int) -> bytes:
        """What the job of a run has written after so many bytes, a piece; nothing where that is all so far."""
        return self.server.ask("GET", f"{_run(name)}/logs?after={after}")

    def history(self, name: str) -> list[Event]:
        """What happened to a run's workers and episodes, each with its reason."""
        return self.server.get(f"{_run(name)}/history", list[Event])

    def scale(self, name: str, workers: int, deadline_s: float = SCALE_DEADLINE_S) -> Status:
        """Give a running run so many workers, and wait until it has them; its status then."""
        request = checked(ScaleRequest, workers=workers, deadline_s=deadline_s)
        return self.server.post(f"{_run(name)}/scale", Status, request)

    def pause(self, name: str, deadline_s: float = SCALE_DEADLINE_S) -> Status:
        """Take all workers from a running run; its status then."""
        return self.server.post(f"{_run(name)}/pause", Status, checked(WaitRequest, deadline_s=deadline_s))

    def unpause(self, name: str, deadline_s: float = SCALE_DEADLINE_S) -> Status:
        """Give a paused run what it had; its status then."""
        return self.server.post(f"{_run(name)}/unpause", Status, checked(WaitRequest, deadline_s=deadline_s))

    def resume(self, name: str) -> Started:
        """Give a paused run its workers, or let a job train what is missing of a stopped run."""
        return self.server.post(f"{_run(name)}/resume", Started)

    def stop(self, name: str, deadline_s: float = STOP_DEADLINE_S) -> Stopped:
        """Stop a run, and wait until it has ended; everything sampled is kept."""
        return self.server.post(f"{_run(name)}/stop", Stopped, checked(StopRequest, deadline_s=deadline_s))

    def metrics(self, name: str) -> list[Row]:
        """Rows of the table `iterations`."""
        return self.server.get(f"{_run(name)}/metrics", list[Row])

    def evaluation(self, name: str) -> Evaluation | None:
        """What the last policy did without noise; None before the training has ended."""
        return self.server.get(f"{_run(name)}/evaluation", Evaluation | None)  # type: ignore[arg-type]

    def figures(self, name: str) -> list[str]:
        """Names of a run's figures."""
        return self.server.get(f"{_run(name)}/figures", list[str])

    def figure(self, name: str, figure: str) -> bytes:
        """A figure as PNG."""
        return self.server.ask("GET", f"{_run(name)}/figures/{quote(figure, safe='')}")

    def versions(self, name: str) -> list[int]:
        """Versions of the policies that are kept."""
        return self.server.get(f"{_run(name)}/policies", list[int])

    def policy(self, name: str, version: int) -> Policy:
        """A policy that acts here."""
        return _policy(self.server, self.server.ask("GET", f"{_run(name)}/policies/{int(version)}"), version)

    def query(self, runs: str, sql: str, /, **parameters: Parameter) -> pa.Table:
        """The result of one SELECT over a run, or over those that match a pattern. RunError where one is damaged."""
        sink = io.BytesIO()
        self.write(runs, sql, QueryForm.ARROW, sink, parameters, _refuse)
        return self.server.table(sink.getvalue())

    def episode(self, name: str, number: int, evaluation: int | None = None, columns: Sequence[str] = ()) -> pa.Table:
        """The frames of an episode of training, or of an evaluation, bit for bit; all columns by default."""
        return self.server.table(self.server.ask("GET", _episode(name, number, evaluation, columns)))

    def replay(self, name: str, number: int | None = None, evaluation: int | None = None) -> Replay:
        """An episode as a page draws it, without a number the newest one."""
        return self.server.get(_replay(name, number, evaluation), Replay)

    def table(self, name: str, table: str) -> pa.Table:
        """A table of a run (docs/data.md)."""
        return self.query(name, f"SELECT * EXCLUDE (run) FROM {table} ORDER BY {_place(table)}")

    def write(self, runs: str, sql: str, form: str, sink: BinaryIO, parameters: Parameters, warn: Warn) -> None:
        """Write such a result as arrow (an IPC stream), parquet, csv or json. `warn` is told of runs left out."""
        for chunk in self.server.chunks("/query", question(runs, sql, form, parameters), warn):
            sink.write(chunk)
        sink.flush()

    def head(self, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Head:
        """The first rows of such a result, as texts for people."""
        sink = io.BytesIO()
        self.write(runs, sql, QueryForm.HEAD, sink, parameters, warn)
        return self.server.read(sink.getvalue(), Head)

    def events(self, name: str, last: str = START) -> Iterator[Update]:
        """What happens to a run after the update whose id is `last`, until the connection ends. ServerError then."""
        return self.server.events(f"{_run(name)}/events", last)

    def files(self, name: str, whole: bool = True) -> dict[str, File]:
        """The files of a run that nobody trains, by their paths in it; or else only those of its world."""
        return self.server.get(f"{_run(name)}/files?whole={str(whole).lower()}", dict[str, File])

    def pieces(self, name: str, path: str, offset: int = 0) -> Iterator[bytes]:
        """The content of a file of a run from a byte on, as it comes."""
        return self.server.pieces(f"{_run(name)}/file?path={quote(path, safe='')}", offset)


def _policy(server: Connection, archive: bytes, version: int) -> Policy:
    try:
        with np.load(io.BytesIO(archive), allow_pickle=False) as arrays:
            layers_n = sum(key.startswith("weight_") for key in arrays.files)
            layers = tuple((arrays[f"weight_{k}"], arrays[f"bias_{k}"]) for k in range(layers_n))
            return Policy(PolicySnapshot(version, layers, float(arrays["offset_m"]), float(arrays["scale_m"])))
    except (ValueError, KeyError, OSError) as error:
        raise server.nonsense(error) from None


def question(runs: str, sql: str, form: str, parameters: Parameters) -> QueryRequest:
    """What is asked of a server. RunError for what can name no run, ServerError for what no server takes."""
    pattern = runs if catalog.is_pattern(runs) else catalog.check_name(runs)
    return checked(QueryRequest, runs=pattern, sql=sql, form=form, parameters=dict(parameters))


def _refuse(warning: str) -> None:
    raise RunError(f"{warning}; name the other runs")


def _place(table: str) -> str:
    """The column that says where in its table a row stands."""
    return "evaluation_id" if table in schema.OF_EVALUATIONS else "iteration"


def _episode(name: str, number: int, evaluation: int | None, columns: Sequence[str]) -> str:
    of = {} if evaluation is None else {"evaluation": int(evaluation)}
    return f"{_run(name)}/episodes/{int(number)}?{urlencode({**of, 'columns': columns}, doseq=True)}"


def _replay(name: str, number: int | None, evaluation: int | None) -> str:
    asked = {"episode": number, "evaluation": evaluation}
    return f"{_run(name)}/replay?{urlencode({key: int(value) for key, value in asked.items() if value is not None})}"


def _run(name: str) -> str:
    """Where a run is. RunError for what can name none."""
    return f"/runs/{catalog.check_name(name)}"
