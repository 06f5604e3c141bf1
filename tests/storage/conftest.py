"""Runs with synthetic data for the tests of storage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from t6gps.storage import catalog, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.records import Episode

Commit = Callable[[Run, int], list[Episode]]


def iteration_row(iteration: int) -> dict[str, object]:
    row: dict[str, object] = dict.fromkeys(schema.ITERATIONS.names, 0)
    return row | {"iteration": iteration, "cost": 0.1 + iteration}


def class_rows(iteration: int) -> list[dict[str, object]]:
    row: dict[str, object] = dict.fromkeys(schema.CLASSES.names, 1)
    flags: dict[str, object] = {"iteration": iteration, "truncated": False, "pooled": True}
    return [row | flags, row | flags | {"entry_edge": None}]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return catalog.create(tmp_path / "runs", "trial", "{}")


@pytest.fixture
def commit(make_episode: Callable[..., Episode]) -> Commit:
    """Commit an iteration of three synthetic episodes, and return them."""

    def commit_three(run: Run, iteration: int) -> list[Episode]:
        episodes = [make_episode(100 * iteration + index, iteration) for index in range(3)]
        tables.commit_iteration(run, iteration, iter(episodes), iteration_row(iteration), class_rows(iteration))
        return episodes

    return commit_three


@pytest.fixture
def rows() -> tuple[Callable[[int], dict[str, object]], Callable[[int], list[dict[str, object]]]]:
    """The makers of an iteration's row and of its classes' rows."""
    return iteration_row, class_rows


@pytest.fixture
def bits() -> Callable[[pa.Table], list[list[bytes]]]:
    """A table's columns as raw bytes, so that -0.0 differs from 0.0."""

    def raw(table: pa.Table) -> list[list[bytes]]:
        columns = []
        for column in table.columns:
            leaf = column.combine_chunks()
            valid = leaf.is_valid().to_pylist()
            flat = leaf.flatten() if pa.types.is_list(leaf.type) else leaf.drop_null()
            if pa.types.is_string(flat.type) or pa.types.is_boolean(flat.type):
                columns.append([str(flat.to_pylist()).encode(), str(valid).encode()])
            else:
                columns.append([flat.to_numpy(zero_copy_only=False).tobytes(), str(valid).encode()])
        return columns

    return raw
