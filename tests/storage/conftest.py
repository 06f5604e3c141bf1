"""Runs with synthetic data for the tests of storage."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from run_digest import column_bytes

from t6gps.storage import catalog, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.records import Episode, Learned, PolicySnapshot

Commit = Callable[[Run, int], list[Episode]]


def iteration_row(iteration: int) -> dict[str, object]:
    row: dict[str, object] = dict.fromkeys(schema.ITERATIONS.names, 0)
    return row | {"iteration": iteration, "cost": 0.1 + iteration}


def class_rows(iteration: int) -> list[dict[str, object]]:
    row: dict[str, object] = dict.fromkeys(schema.CLASSES.names, 1)
    flags: dict[str, object] = {"iteration": iteration, "truncated": False, "pooled": True}
    return [row | flags, row | flags | {"entry_edge": None}]


def policy(version: int) -> PolicySnapshot:
    """A small random policy."""
    rng = np.random.default_rng(version)
    widths = ((3, 4), (4, 2))
    layers = tuple(
        (rng.normal(size=(outputs, inputs)).astype(np.float32), rng.normal(size=outputs).astype(np.float32))
        for inputs, outputs in widths
    )
    return PolicySnapshot(version, layers, 0.9, 0.2)


def learned(number: int, **changed: Any) -> Learned:
    """What an iteration leaves beside its episodes; parts may be given."""
    model = {field.name: [0.5, -0.0] if pa.types.is_list(field.type) else 1 for field in schema.MODELS}
    models = pa.Table.from_pylist([model | {"iteration": number, "truncated": None, "pooled": True}], schema.MODELS)
    return Learned(
        **{
            "iteration": iteration_row(number),
            "classes": class_rows(number),
            "models": models,
            "policies": [policy(version) for version in ((0, 1) if number == 0 else (number + 1,))],
        }
        | changed
    )


@pytest.fixture(scope="session")
def learn() -> Callable[..., Learned]:
    """learn(iteration, **parts) is what an iteration leaves beside its episodes."""
    return learned


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return catalog.create(tmp_path / "runs", "trial", "{}")


@pytest.fixture
def commit(make_episode: Callable[..., Episode]) -> Commit:
    """Commit an iteration of three synthetic episodes, and return them."""

    def commit_three(run: Run, iteration: int) -> list[Episode]:
        episodes = [make_episode(100 * iteration + index, iteration) for index in range(3)]
        iterations.commit(run, iteration, iter(episodes), learned(iteration))
        return episodes

    return commit_three


@pytest.fixture
def commit_cut_off(commit: Commit, tmp_path: Path) -> Callable[[Run, int, str, str], list[Episode]]:
    """commit_cut_off(run, iteration, committed, written) leaves what a crash within a commit leaves.

    The tables `committed` have the iteration, the table `written` has its file alone, the others know nothing of it.
    """

    def cut_off(run: Run, iteration: int, committed: str, written: str = "") -> list[Episode]:
        ahead = Run(tmp_path / "ahead")
        shutil.copytree(run.path, ahead.path)
        episodes = commit(ahead, iteration)
        for table in committed.split():
            shutil.copytree(ahead.tables / table, run.tables / table, dirs_exist_ok=True)
        for table in written.split():
            file = f"iteration-{iteration:06d}.parquet"
            (run.tables / table).mkdir(exist_ok=True)
            shutil.copy(ahead.tables / table / file, run.tables / table / file)
        shutil.rmtree(ahead.path)
        return episodes

    return cut_off


@pytest.fixture
def full_disk() -> Callable[[], AbstractContextManager[None]]:
    """Within `full_disk()` nothing can be written to a file, as where no space is left."""

    @contextmanager
    def full() -> Iterator[None]:
        before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, most))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))

    return full


@pytest.fixture
def bits() -> Callable[[pa.Table], list[list[bytes]]]:
    """A table's columns as raw bytes, so that -0.0 differs from 0.0."""
    return lambda table: [list(column_bytes(column)) for column in table.columns]
