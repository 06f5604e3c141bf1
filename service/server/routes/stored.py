"""Routes that give what runs have stored: figures, policies, results of queries, and files."""

from __future__ import annotations

import io
import json
import os
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from http import HTTPStatus
from pathlib import Path as FilePath
from typing import Annotated

import numpy as np
import pyarrow as pa
from fastapi import APIRouter, HTTPException, Path, Query
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse

from t6gps.service.api import asking as questions
from t6gps.service.launch.fetch import File, FolderSource
from t6gps.service.remote.messages import NUMBER_MOST, WARNINGS, ColumnName, QueryForm, QueryRequest
from t6gps.service.server.routes.access import (
    REFUSALS,
    Answers,
    Asker,
    NamedRun,
    NoSuchRunError,
    Place,
    Reading,
    contents,
)
from t6gps.service.training import evaluation, policies
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.views import replay
from t6gps.service.views.replay import Replay
from t6gps.storage import checkpoint, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.sql import query as sql

routes = APIRouter(prefix="/v1/runs", dependencies=[Reading], responses=REFUSALS, tags=["read"])
asking = APIRouter(dependencies=[Reading], responses=REFUSALS, tags=["read"])
WARNINGS_N = 20
CHUNK_BYTES_N = 2**18
ARCHIVE = "application/octet-stream"
MEDIA = {
    QueryForm.ARROW: "application/vnd.apache.arrow.stream",
    QueryForm.PARQUET: "application/vnd.apache.parquet",
    QueryForm.CSV: "text/csv",
    QueryForm.JSON: "application/json",
}


@routes.get("/{name}/evaluation")
def evaluated(run: NamedRun) -> Evaluation | None:
    """What the last policy did without noise; null before the training has ended."""
    return evaluation.kept(run)


@routes.get("/{name}/figures")
def figures(run: NamedRun) -> list[str]:
    """Names of the figures."""
    return sorted(path.name for path in run.figures.glob("*.png"))


RANGES: Answers = {
    206: {"content": {ARCHIVE: {}}, "description": "The range that was asked for."},
    416: {"content": {"text/plain": {}}, "description": "There is no such range."},
}
"""How else a file may be answered."""


@routes.get(
    "/{name}/figures/{figure}", response_class=FileResponse, responses=contents(["image/png"], "A picture.") | RANGES
)
def figure(run: NamedRun, figure: Annotated[str, Path(max_length=100)]) -> FileResponse:
    """A figure as PNG."""
    found = {path.name: path for path in run.figures.glob("*.png")}
    if figure not in found:
        raise HTTPException(
            HTTPStatus.NOT_FOUND, f"there is no figure {figure!r}; figures: {', '.join(found) or 'none'}"
        )
    return FileResponse(found[figure], media_type="image/png")


@routes.get("/{name}/policies")
def versions(run: NamedRun) -> list[int]:
    """Versions of the policies that are kept."""
    return policies.versions(run)


@routes.get(
    "/{name}/policies/{version}",
    response_class=Response,
    responses=contents([ARCHIVE], "An .npz archive without pickle."),
)
def policy(run: NamedRun, version: Annotated[int, Path(ge=0, le=NUMBER_MOST)], place: Place) -> Response:
    """Weights of a policy: `offset_m`, `scale_m`, and `weight_K`, `bias_K` of each layer."""
    if version not in policies.versions(run):
        raise HTTPException(HTTPStatus.NOT_FOUND, f"run {run.name} keeps no policy of version {version}")
    with place.reading.taken():
        snapshot = policies.load(run, version)
    arrays = {"offset_m": np.array(snapshot.offset_m), "scale_m": np.array(snapshot.scale_m)}
    weights = {f"weight_{k}": weight for k, (weight, _) in enumerate(snapshot.layers)}
    biases = {f"bias_{k}": bias for k, (_, bias) in enumerate(snapshot.layers)}
    return Response(checkpoint.packed({**arrays, **weights, **biases}), media_type=ARCHIVE)


@asking.post("/v1/query", response_class=Response, responses=contents(MEDIA.values(), "The result."))
def query(request: QueryRequest, place: Place, asker: Asker) -> Response:
    """The result of one SELECT over a run or many. The header T6GPS-Warnings says which damaged ones it is without."""
    warnings = list[str]()
    try:
        question = questions.question(place.root, request.runs, request.sql, request.parameters, warnings.append)
    except RunError as error:
        raise NoSuchRunError(*error.args) from None
    question = replace(question, timeout_s=place.query_s)
    if request.form is QueryForm.HEAD:
        with place.asking.taken(asker):
            return JSONResponse(asdict(sql.head(question)), headers=_warned(warnings))
    with ExitStack() as room:
        room.enter_context(place.answers.taken(asker))
        with place.asking.taken(asker):
            file = sql.answer(question, request.form)  # whoever takes it slowly holds no memory
        weakref.finalize(file, room.pop_all().close)  # its last reader, done or gone, makes room
    headers = {"Content-Length": str(os.fstat(file.fileno()).st_size), **_warned(warnings)}
    chunks = iter(lambda: file.read(CHUNK_BYTES_N), b"")
    return StreamingResponse(chunks, media_type=MEDIA[request.form], headers=headers)


def _warned(warnings: Sequence[str]) -> dict[str, str]:
    """The header with warnings, as many as a header holds."""
    told = list(warnings[:WARNINGS_N])
    told += [f"left out: {len(warnings) - WARNINGS_N} more runs"] if len(warnings) > WARNINGS_N else []
    return {WARNINGS: json.dumps(told)} if told else {}


@routes.get(
    "/{name}/episodes/{number}", response_class=Response, responses=contents([MEDIA[QueryForm.ARROW]], "An IPC stream.")
)
def episode(
    run: NamedRun,
    number: Annotated[int, Path(ge=0, le=NUMBER_MOST)],
    place: Place,
    evaluation: Annotated[int | None, Query(ge=0, le=NUMBER_MOST)] = None,
    columns: Annotated[list[ColumnName] | None, Query(max_length=len(schema.FRAMES))] = None,
) -> Response:
    """The frames of an episode of training, or of an evaluation, bit for bit; all columns, or those that are named."""
    sink = io.BytesIO()
    with place.reading.taken():
        frames = tables.episode(run, number, evaluation, columns).frames
    with pa.ipc.new_stream(sink, frames.schema) as writer:
        writer.write_table(frames)
    return Response(sink.getvalue(), media_type=MEDIA[QueryForm.ARROW])


@routes.get("/{name}/replay")
def replayed(
    run: NamedRun,
    place: Place,
    episode: Annotated[int | None, Query(ge=0, le=NUMBER_MOST)] = None,
    evaluation: Annotated[int | None, Query(ge=0, le=NUMBER_MOST)] = None,
) -> Replay:
    """An episode as a page draws it; without a number the newest one, which perhaps waits for its iteration."""
    if episode is None and evaluation is not None:
        raise HTTPException(HTTPStatus.BAD_REQUEST, "an evaluation has many episodes; say which with episode=0")
    with place.reading.taken():
        return replay.of_newest(run) if episode is None else replay.of_stored(run, episode, evaluation)


@routes.get("/{name}/files")
def files(run: NamedRun, place: Place, whole: bool = True) -> dict[str, File]:
    """The files of a run that nobody trains, by their paths in it; or else only those of its world."""
    with place.copying.taken():
        source = FolderSource(run)
        return source.files() if whole else source.essentials()


@routes.get("/{name}/file", response_class=FileResponse, responses=contents([ARCHIVE], "Its content.") | RANGES)
def file(run: NamedRun, path: Annotated[str, Query(max_length=1000)]) -> FileResponse:
    """A file of a run, or a range of it."""
    found = _file(run, path)
    if found is None:
        raise HTTPException(HTTPStatus.NOT_FOUND, f"run {run.name} has no file {path!r}; see its list of files")
    return FileResponse(found, media_type=ARCHIVE)


def _file(run: Run, path: str) -> FilePath | None:
    """A file by its path in a run, None for what names none of those that `files` lists."""
    try:
        inside, found = run.path.resolve(), (run.path / path).resolve()
        known = found.is_relative_to(inside) and found.is_file() and not path.startswith((".", "/"))
        return found if known and ".." not in FilePath(path).parts else None
    except (OSError, ValueError):  # too long, or with a NUL
        return None
