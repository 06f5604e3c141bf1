"""Routes that change runs; each change has its line in the audit."""

from __future__ import annotations

import json
from http import HTTPStatus

from fastapi import APIRouter

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.service.launch import control
from t6gps.service.remote.messages import ScaleRequest, Started, StartRequest, Stopped, StopRequest, WaitRequest
from t6gps.service.server.routes.access import REFUSALS, Name, NamedRun, Operation, Place, training
from t6gps.service.steering import requests
from t6gps.service.steering.status import Status
from t6gps.service.training import origin, session
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError

routes = APIRouter(prefix="/v1/runs", responses=REFUSALS, tags=["operate"])


@routes.post("", status_code=HTTPStatus.ACCEPTED)
def start(operation: Operation, request: StartRequest, place: Place) -> Started:
    """Create a run, or go on with one, and let a job train it."""
    operation.update(request.model_dump())
    config, warnings = _config(request), list[str]()
    if config.terrain.file is not None:
        raise ConfigError("terrain.file names a file of the server, out of reach from here; leave it out")
    default = request.default_name or request.preset or "run"
    run = session.begin(config, place.root, request.name, default, request.resume, warnings.append)
    try:
        job = place.launch(run, config)
    except BaseException:
        if not request.resume:  # else it may be in use by now
            catalog.discard_unused(run)
        raise
    operation["run"] = run.name
    return Started(name=run.name, job=job, warnings=warnings)


@routes.post("/{name}/scale")
def scale(operation: Operation, run: NamedRun, request: ScaleRequest, place: Place) -> Status:
    """Give a running run so many workers, and wait until it has them; its status then."""
    operation.update(request.model_dump())
    with place.operating.taken():
        return control.scale(place.root, run.name, training(place, run.name), request.workers, request.deadline_s)


@routes.post("/{name}/pause")
def pause(operation: Operation, run: NamedRun, request: WaitRequest, place: Place) -> Status:
    """Take all workers from a running run; its status then."""
    operation.update(request.model_dump())
    with place.operating.taken():
        return requests.pause(run, request.deadline_s)


@routes.post("/{name}/unpause")
def unpause(operation: Operation, run: NamedRun, request: WaitRequest, place: Place) -> Status:
    """Give a paused run the workers, or the autoscaling, that it had; its status then."""
    operation.update(request.model_dump())
    with place.operating.taken():
        return requests.unpause(run, request.deadline_s)


@routes.post("/{name}/resume", status_code=HTTPStatus.ACCEPTED)
def resume(operation: Operation, run: NamedRun, place: Place) -> Started:
    """Give a paused run its workers, or let a job train what is missing of a stopped run."""
    with place.operating.taken():
        if catalog.process_of(run) is None:
            return Started(name=run.name, job=place.launch(run, origin.configured(run)))
        requests.unpause(run)
        return Started(name=run.name, job=None)


@routes.post("/{name}/stop")
def stop(operation: Operation, name: Name, request: StopRequest, place: Place) -> Stopped:
    """Stop a run or its job, and wait until it has ended; everything sampled is kept."""
    operation.update(request.model_dump())
    warnings: list[str] = []
    with place.operating.taken():
        job = training(place, name)
        sentence = control.stop(place.root, name, job, request.deadline_s, warnings.append)
    return Stopped(sentence=sentence, warnings=warnings)


def _config(request: StartRequest) -> Config:
    """What is to be trained. ConfigError for what cannot be."""
    overrides = [f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in request.settings.items()]
    if (request.preset is None) == (request.toml is None):
        raise ConfigError("a run starts from a preset or from the text of a file; give one of preset and toml")
    if request.toml is not None:
        return configuration.from_toml(request.toml, overrides, "the file")
    if request.preset not in configuration.presets():
        raise ConfigError(f"unknown preset {request.preset!r}; allowed: {', '.join(configuration.presets())}")
    return configuration.load(request.preset, overrides)
