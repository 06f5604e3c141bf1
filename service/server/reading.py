"""Routes that change nothing."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Iterable
from dataclasses import asdict
from http import HTTPStatus
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Header, HTTPException, Path
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from t6gps.service.remote.messages import QueryForm, QueryRequest
from t6gps.service.server import updates
from t6gps.service.server.access import REFUSALS, NamedRun, Place, Reading, Slots
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.service.training import evaluation, policies, summary
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.summary import Row, RunSummary
from t6gps.storage import catalog, checkpoint
from t6gps.storage.sql import query as sql

routes = APIRouter(prefix="/v1/runs", dependencies=[Reading], responses=REFUSALS, tags=["read"])
ITERATIONS_MOST = 10**9
CHUNK_BYTES_N = 2**16
ARCHIVE = "application/octet-stream"
MEDIA = {
    QueryForm.ARROW: "application/vnd.apache.arrow.stream",
    QueryForm.CSV: "text/csv",
    QueryForm.JSON: "application/json",
}


def _contents(kinds: Iterable[str], what: str) -> dict[int | str, dict[str, object]]:
    """What a route answers with, for the document."""
    return {200: {"content": {kind: {} for kind in kinds}, "description": what}}


@routes.get("")
def runs(place: Place) -> list[RunSummary]:
    """The runs, damaged ones included."""
    with place.reading.taken():
        return [summary.summary(run) for run in catalog.list_runs(place.root)]


@routes.get("/{name}/status")
def status(run: NamedRun) -> Status:
    """How a run is: its workers, what is under way, who waits for whom and since when."""
    return statuses.status(run)


@routes.get("/{name}/metrics")
def metrics(run: NamedRun, place: Place) -> list[Row]:
    """The learning curve: rows of the table `iterations`."""
    with place.reading.taken():
        return summary.iterations(run)


@routes.get("/{name}/evaluation")
def evaluated(run: NamedRun) -> Evaluation | None:
    """What the last policy did without noise; null before the training has ended."""
    return evaluation.kept(run)


@routes.get("/{name}/figures")
def figures(run: NamedRun) -> list[str]:
    """Names of the figures."""
    return sorted(path.name for path in run.figures.glob("*.png"))


@routes.get("/{name}/figures/{figure}", response_class=Response, responses=_contents(["image/png"], "A picture."))
def figure(run: NamedRun, figure: Annotated[str, Path(max_length=100)]) -> Response:
    """A figure as PNG."""
    found = {path.name: path for path in run.figures.glob("*.png")}
    if figure not in found:
        raise HTTPException(
            HTTPStatus.NOT_FOUND, f"there is no figure {figure!r}; figures: {', '.join(found) or 'none'}"
        )
    return Response(found[figure].read_bytes(), media_type="image/png")


@routes.get("/{name}/policies")
def versions(run: NamedRun) -> list[int]:
    """Versions of the policies that are kept."""
    return policies.versions(run)


@routes.get(
    "/{name}/policies/{version}",
    response_class=Response,
    responses=_contents([ARCHIVE], "An .npz archive without pickle."),
)
def policy(run: NamedRun, version: Annotated[int, Path(ge=0, le=ITERATIONS_MOST)], place: Place) -> Response:
    """Weights of a policy: `offset_m`, `scale_m`, and `weight_K`, `bias_K` of each layer."""
    if version not in policies.versions(run):
        raise HTTPException(HTTPStatus.NOT_FOUND, f"run {run.name} keeps no policy of version {version}")
    with place.reading.taken():
        snapshot = policies.load(run, version)
    arrays = {"offset_m": np.array(snapshot.offset_m), "scale_m": np.array(snapshot.scale_m)}
    weights = {f"weight_{k}": weight for k, (weight, _) in enumerate(snapshot.layers)}
    biases = {f"bias_{k}": bias for k, (_, bias) in enumerate(snapshot.layers)}
    return Response(checkpoint.packed({**arrays, **weights, **biases}), media_type=ARCHIVE)


@routes.post("/{name}/query", response_class=Response, responses=_contents(MEDIA.values(), "The result."))
def query(run: NamedRun, question: QueryRequest, place: Place) -> Response:
    """The result of one SELECT over the tables of a run."""
    if question.form is QueryForm.HEAD:
        with place.reading.taken():
            return JSONResponse(asdict(sql.head(run, question.sql)))
    file = tempfile.TemporaryFile()  # noqa: SIM115 # whoever takes it slowly holds no memory, and the end closes it
    with place.reading.taken():
        sql.write(run, question.sql, question.form, file)
    size_n = file.tell()
    file.seek(0)
    chunks = iter(lambda: file.read(CHUNK_BYTES_N), b"")
    return StreamingResponse(chunks, media_type=MEDIA[question.form], headers={"Content-Length": str(size_n)})


@routes.get(
    "/{name}/events",
    response_class=StreamingResponse,
    responses=_contents(["text/event-stream"], "Events."),
)
async def events(
    run: NamedRun,
    place: Place,
    last_event_id: Annotated[int, Header(ge=updates.NONE, le=ITERATIONS_MOST)] = updates.NONE,
) -> StreamingResponse:
    """Live updates as server-sent events: iterations with their ids, changes of the status."""
    place.streams.take()

    return _Stream(updates.stream(run, last_event_id), place.streams)


class _Stream(StreamingResponse):
    """A stream of events, which gives its slot back however it ends."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncIterator[str], slots: Slots) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store"})
        self._slots = slots

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._slots.give_back()
