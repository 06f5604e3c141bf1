"""Routes that say how runs are, and what happens to them."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from t6gps.service.remote.messages import CursorText
from t6gps.service.remote.stream import START
from t6gps.service.server import updates
from t6gps.service.server.feed import Cursor
from t6gps.service.server.routes.access import REFUSALS, Asker, Name, NamedRun, Place, Reading, contents, named
from t6gps.service.server.routes.streaming import EventStream
from t6gps.service.steering import events as happened
from t6gps.service.steering import status as statuses
from t6gps.service.steering.events import Event
from t6gps.service.steering.status import Status
from t6gps.service.training import summary
from t6gps.service.training.summary import Row, RunSummary
from t6gps.storage import catalog

routes = APIRouter(prefix="/v1/runs", dependencies=[Reading], responses=REFUSALS, tags=["read"])


@routes.get("")
def runs(place: Place) -> list[RunSummary]:
    """The runs, damaged ones included."""
    with place.reading.taken():
        return [summary.summary(run) for run in catalog.list_runs(place.root)]


@routes.get("/{name}/status")
async def status(name: Name, place: Place) -> Status:  # async: many ask often, and a call in a thread is half the cost
    """How a run is: its workers, what is under way, who waits for whom and since when."""
    return await run_in_threadpool(lambda: statuses.status(named(place, name)))


@routes.get("/{name}/metrics")
def metrics(run: NamedRun, place: Place) -> list[Row]:
    """The learning curve: rows of the table `iterations`."""
    with place.reading.taken():
        return summary.iterations(run)


@routes.get("/{name}/history")
def history(run: NamedRun, place: Place) -> list[Event]:
    """What happened to a run's workers and episodes, each with its reason."""
    with place.reading.taken():
        return happened.read(run)


@routes.get(
    "/{name}/events",
    response_class=StreamingResponse,
    responses=contents(["text/event-stream"], "Events."),
)
async def events(
    run: NamedRun,
    place: Place,
    asker: Asker,
    last_event_id: Annotated[CursorText, Header()] = START,
) -> StreamingResponse:
    """Live updates as server-sent events: iterations and events of the pool with their ids, changes of the status."""
    return EventStream(place, asker, updates.stream(place.feeds, run, Cursor.of(last_event_id)))
