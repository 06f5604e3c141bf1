"""Iterations of random rows that fit together, for processes that no fixture reaches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from t6gps.service.config import load
from t6gps.service.training import origin
from t6gps.storage import checkpoint, fields, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.records import Episode, Learned, PolicySnapshot

EPISODES_N, STEPS = 3, 5
FRAMES_N = EPISODES_N * (STEPS + 1)


def episodes(iteration: int) -> list[Episode]:
    """The episodes of an iteration, always the same."""
    return [_episode(EPISODES_N * iteration + index, iteration, index) for index in range(EPISODES_N)]


def commit(run: Run, iteration: int) -> None:
    """Commit an iteration."""
    row = dict.fromkeys(schema.ITERATIONS.names, 0) | {
        "iteration": iteration, "policy_version": iteration, "episodes": EPISODES_N, "steps": EPISODES_N * STEPS
    }  # fmt: skip
    versions = (0, 1) if iteration == 0 else (iteration + 1,)
    layer = (np.ones((24, 83), np.float32), np.zeros(24, np.float32))
    policies = [PolicySnapshot(version, (layer,), 0.9, 0.2) for version in versions]
    learned = Learned(row, [], schema.MODELS.empty_table(), policies)
    iterations.commit(run, iteration, iter(episodes(iteration)), learned)


def made(root: Path, iterations_n: int, name: str = "rolling") -> Run:
    """A sound run of so many iterations, with their checkpoints."""
    run = origin.create(load("flat-quick"), root, name)
    for iteration in range(iterations_n):
        commit(run, iteration)
        checkpoint.save(run.checkpoints, iteration + 1, {"ledger": {}}, {"weights": np.arange(100.0) + iteration})
    return run


def _episode(episode_id: int, iteration: int, index: int) -> Episode:
    rng = np.random.default_rng(episode_id)
    given = {"episode_id": episode_id, "iteration": iteration, "policy_version": iteration, "steps": STEPS}
    tables = (
        _rows(definition, rows_n, {**given, "index": index, "step": np.arange(rows_n)}, rng)
        for definition, rows_n in ((schema.FRAMES, STEPS + 1), (schema.EPISODES, 1))
    )
    return Episode(*tables)


def _rows(definition: pa.Schema, rows_n: int, given: dict[str, Any], rng: np.random.Generator) -> pa.Table:
    columns = []
    for field in definition:
        length = fields.vector_length(field)
        if field.name in given:
            values: Any = np.broadcast_to(given[field.name], rows_n)
        elif length is not None:
            values = list(rng.normal(size=(rows_n, length)).astype(np.float32))
        else:
            values = ["completed"] * rows_n if pa.types.is_string(field.type) else rng.integers(0, 9, rows_n)
        columns.append(pa.array(values, field.type))
    return pa.table(columns, schema=definition)
