"""Evaluations in the tables of a run: whole episodes, and what they were run for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum

import pyarrow as pa

from t6gps.service import config as configuration
from t6gps.service import provenance
from t6gps.service.config import Config
from t6gps.service.training import origin
from t6gps.service.training.evaluation import Evaluation
from t6gps.storage import catalog, durable, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import evaluations
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.spool import Spool, read


class Purpose(StrEnum):
    """Why there is an evaluation: it ended the training, a study's condition wants it, or somebody asked."""

    TRAINING = "training"
    CONDITION = "condition"
    EVAL = "eval"


@dataclass(frozen=True)
class Occasion:
    """What an evaluation is for, and where.

    condition      its name in a study, for that purpose
    terrain_seed   of the ground alone
    """

    purpose: Purpose
    condition: str | None = None
    terrain_seed: int | None = None
    engine: str = "bullet"


@contextmanager
def collecting(run: Run) -> Iterator[Spool]:
    """Where the episodes of an evaluation wait for each other. RunError where the run takes no files."""
    try:
        durable.sweep(run.path)
        with catalog.evaluating(run), durable.draft(run.path / "evaluation") as folder:
            yield Spool(folder, 0)
    except PermissionError as error:
        raise RunError(
            f"run {run.name} cannot keep an evaluation: {error.filename}: {error.strerror}; get permission to write, "
            "or evaluate with --no-keep"
        ) from error


def commit(
    run: Run, config: Config, result: Evaluation, episodes: Spool, occasion: Occasion, policy_version: int
) -> int:
    """Commit an evaluation and its episodes; its number. One for training or a condition is committed once."""
    if occasion.purpose is not Purpose.EVAL:
        known = _number(run, occasion, policy_version)
        if known is not None:
            return known
    row: dict[str, object] = {
        "purpose": occasion.purpose.value,
        "condition": occasion.condition,
        "policy_version": policy_version,
        "episodes": result.episodes,
        "seed": result.seed,
        "terrain_seed": occasion.terrain_seed,
        "settings": json.dumps(configuration.changed(origin.configured(run), config)),
        "engine": occasion.engine,
        "commit": provenance.commit(),
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    for name, estimate in result.estimates().items():
        row |= {name: estimate.mean, f"{name}_standard_error": estimate.standard_error}
    return evaluations.commit(run, row, (read(file) for file in episodes.files()))


def world(run: Run, kept: pa.Table, evaluation_id: int) -> Config:
    """The configuration of an evaluation, of those that the table `kept` has. DataError naming them."""
    settings = {row["evaluation_id"]: row["settings"] for row in kept.to_pylist()}
    if evaluation_id not in settings:
        known = ", ".join(map(str, settings)) or "none"
        raise DataError(f"run {run.name} keeps no evaluation {evaluation_id}; kept: {known}")
    changed = json.loads(settings[evaluation_id])
    return origin.configured(run, [f"{key}={json.dumps(value)}" for key, value in changed.items()])


def _number(run: Run, occasion: Occasion, policy_version: int) -> int | None:
    """The number of an evaluation that is committed already."""
    rows = tables.read(run, "evaluations", ["evaluation_id", "purpose", "condition", "policy_version"]).to_pylist()
    wanted = (occasion.purpose.value, occasion.condition, policy_version)
    return next(
        (row["evaluation_id"] for row in rows if (row["purpose"], row["condition"], row["policy_version"]) == wanted),
        None,
    )
