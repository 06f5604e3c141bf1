"""Routes that change runs; each change has its line in the audit."""

from __future__ import annotations

import json
from http import HTTPStatus

from fastapi import APIRouter

from t6gps.service import config as configuration
from t6gps.service.remote.messages import ScaleRequest, Started, StartRequest
from t6gps.service.server import jobs
from t6gps.service.server.access import REFUSALS, NamedRun, Operation, Place
from t6gps.service.steering import requests
from t6gps.service.steering.status import Status
from t6gps.service.training import session
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError

routes = APIRouter(prefix="/v1/runs", responses=REFUSALS, tags=["operate"])
OUT_OF_REACH = "terrain.file"
"""A setting that names a file, which nobody may choose from afar."""


@routes.post("", status_code=HTTPStatus.ACCEPTED)
def start(operation: Operation, request: StartRequest, place: Place) -> Started:
    """Create a run of a preset, and let a process work on it."""
    operation.update(request.model_dump())
    if request.preset not in configuration.presets():
        raise ConfigError(f"unknown preset {request.preset!r}; allowed: {', '.join(configuration.presets())}")
    if OUT_OF_REACH in request.settings:
        raise ConfigError(f"{OUT_OF_REACH} names a file of the server, out of reach from here; leave it out")
    overrides = [f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in request.settings.items()]
    config = configuration.load(request.preset, overrides)
    run = session.begin(config, place.root, request.name, request.preset, False, _nothing_to_warn_of)
    try:
        pid = place.launch(run)
    except BaseException:
        catalog.discard_unused(run)
        raise
    operation["run"] = run.name
    return Started(name=run.name, pid=pid)


@routes.post("/{name}/scale")
def scale(operation: Operation, run: NamedRun, request: ScaleRequest, place: Place) -> Status:
    """Give a running run so many workers, and wait until it has them; its status then."""
    operation.update(request.model_dump())
    with place.operating.taken():
        return requests.scale(run, request.workers, request.deadline_s)


@routes.post("/{name}/pause")
def pause(operation: Operation, run: NamedRun, place: Place) -> Status:
    """Take all workers from a running run; its status then."""
    with place.operating.taken():
        return requests.pause(run)


@routes.post("/{name}/resume", status_code=HTTPStatus.ACCEPTED)
def resume(operation: Operation, run: NamedRun, place: Place) -> Started:
    """Give a paused run its workers, or a stopped run a process."""
    with place.operating.taken():
        return Started(name=run.name, pid=jobs.resume(run, place.launch))


@routes.post("/{name}/stop", status_code=HTTPStatus.NO_CONTENT)
def stop(operation: Operation, run: NamedRun, place: Place) -> None:
    """Stop a run, and wait until it has ended; everything sampled is kept."""
    with place.operating.taken():
        requests.stop(run)


def _nothing_to_warn_of(sentence: str) -> None:
    """A run that is created now was made by what there is now."""
    raise AssertionError(sentence)
