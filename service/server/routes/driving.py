"""Routes to drive policies: somebody begins and steers, and whoever may read can look.

Commands change nothing that is kept, so that they have no line in the audit; what begins or ends a drive has one.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Path
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from t6gps.service.driving import order as orders
from t6gps.service.driving.commands import Command
from t6gps.service.driving.drive import Drive
from t6gps.service.driving.drives import Steered
from t6gps.service.driving.order import Order
from t6gps.service.remote.messages import DriveBegun, DriveRequest
from t6gps.service.server.routes.access import (
    REFUSALS,
    Asker,
    Operating,
    Operation,
    Place,
    Reading,
    contents,
    named,
)
from t6gps.service.server.routes.streaming import CHECK_S, EventStream

routes = APIRouter(prefix="/v1/drives", responses=REFUSALS, tags=["drive"])


async def _drive(place: Place, drive: Annotated[str, Path(max_length=40, description="Of a drive.")]) -> Steered:
    found = place.drives.get(drive)
    if found is None:
        raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no drive {drive!r}, or it has ended; begin another one")
    return found


UnderWay = Annotated[Steered, Depends(_drive)]


@routes.post("", status_code=HTTPStatus.CREATED)
async def begin(operation: Operation, request: DriveRequest, place: Place, asker: Asker) -> DriveBegun:
    """Let policies run in the simulator; it ends when nobody looks for ten seconds."""
    operation.update(request.model_dump())
    place.drives.check_room()  # before much is read

    def wanted() -> Order:
        first, *others = ((named(place, entry.run), entry.version) for entry in request.entries)
        with place.reading.taken():
            leader = orders.entrant(*first, request.evaluation)
            entrants = [leader, *(orders.entrant(*other) for other in others)]
            difficulty = leader.settings.terrain.difficulty
            began = orders.start(first[0], request.episode, request.evaluation, difficulty)
        return orders.order(entrants, began, request.terrain_difficulty, request.friction)

    order = await run_in_threadpool(wanted)
    return DriveBegun(id=place.drives.begin(order, asker.id, asker.name, lambda: place.holds(asker)))


@routes.get(
    "/{drive}/frames",
    dependencies=[Reading],
    response_class=StreamingResponse,
    responses=contents(["text/event-stream"], "Events."),
)
async def frames(found: UnderWay, place: Place, asker: Asker) -> StreamingResponse:
    """What is seen, as server-sent events: scene, frame ten times a second, steered, and end with the reason."""
    return EventStream(place, asker, _events(found.drive))


@routes.post("/{drive}", dependencies=[Operating], status_code=HTTPStatus.NO_CONTENT)
async def steer(found: UnderWay, command: Command, asker: Asker) -> None:
    """Change what a command says; whoever has the token that began the drive may, and the last one counts."""
    if asker.id != found.token:
        sentence = f"token {found.name!r} began this drive and steers it; look on, or begin a drive of your own"
        raise HTTPException(HTTPStatus.FORBIDDEN, sentence)
    found.drive.obey(command)


@routes.delete("/{drive}", status_code=HTTPStatus.NO_CONTENT)
async def end(operation: Operation, found: UnderWay, asker: Asker) -> None:
    """End a drive, and return when its process is gone."""
    await found.drive.end(f"token {asker.name!r} has ended this drive; begin another one")


async def _events(drive: Drive) -> AsyncGenerator[str | None, None]:
    with drive.watched() as watch:
        async for news in watch.news(CHECK_S):
            yield None if news is None else f"event: {news.kind}\ndata: {news.text}\n\n"
