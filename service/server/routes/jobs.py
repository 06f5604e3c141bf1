"""Routes about the jobs that train runs of the root, and what they have written."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import Response

from t6gps.service.launch import control
from t6gps.service.launch import job as records
from t6gps.service.launch.control import JobLine, Standing
from t6gps.service.server.routes.access import REFUSALS, Name, Place, Reading, contents, training
from t6gps.storage.errors import RunError

routes = APIRouter(prefix="/v1", dependencies=[Reading], responses=REFUSALS, tags=["read"])
PIECE_BYTES_N = 2**20
LONGEST_BYTES_N = 2**50
TEXT = "text/plain"


@routes.get("/jobs")
def jobs(place: Place) -> list[JobLine]:
    """The jobs that train runs of this root, and how each is."""
    with place.reading.taken():
        return [control.line(job) for job in records.of_root(place.root)]


@routes.get("/runs/{name}/standing")
def standing(place: Place, name: Name) -> Standing:
    """How a run is, and the job that trains it, also where it has not begun or cannot begin."""
    return control.standing(place.root, name, training(place, name))


@routes.get("/runs/{name}/logs", response_class=Response, responses=contents([TEXT], "Text in UTF-8."))
def logs(place: Place, name: Name, after: Annotated[int, Query(ge=0, le=LONGEST_BYTES_N)] = 0) -> Response:
    """What the job of a run has written after so many bytes, a piece at a time; nothing where that is all so far."""
    job = control.named(name, training(place, name), records.of_root(place.root))
    try:
        with job.folder.log.open("rb") as file:
            file.seek(after)
            return Response(file.read(PIECE_BYTES_N), media_type=TEXT)
    except FileNotFoundError:
        raise RunError(f"job {job.name} has no log {job.folder.log} yet; see t6gps jobs") from None
