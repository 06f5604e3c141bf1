"""Runs whose rows fit together, for the tests of what looks after them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import catalog, checkpoint, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import evaluations, iterations
from t6gps.storage.records import Episode, Learned

STEPS, EPISODES_N = 5, 3


def coherent(learned: Learned, episodes_n: int = EPISODES_N) -> Learned:
    """What an iteration of so many episodes leaves, with true counts."""
    number = learned.iteration["iteration"]
    counts = {"episodes": episodes_n, "steps": STEPS * episodes_n, "policy_version": number}
    return Learned({**learned.iteration, **counts}, learned.classes, learned.models, learned.policies)


@pytest.fixture
def iterate(make_episode: Callable[..., Episode], learn: Callable[..., Learned]) -> Callable[[Run, int], None]:
    """iterate(run, n) commits iteration n and its checkpoint."""

    def iterated(run: Run, number: int) -> None:
        episodes = [make_episode(100 * number + index, number) for index in range(EPISODES_N)]
        iterations.commit(run, number, iter(episodes), coherent(learn(number)))
        checkpoint.save(run.checkpoints, number + 1, {"ledger": None}, {"weights": np.arange(3.0)})

    return iterated


@pytest.fixture
def evaluate(make_episode: Callable[..., Episode]) -> Callable[[Run, int], int]:
    """evaluate(run, version) commits an evaluation of that policy; its number."""

    def evaluated(run: Run, version: int) -> int:
        names = [column for column in schema.EVALUATIONS if column.name != "evaluation_id"]
        row: dict[str, Any] = {column.name: "{}" if column.type == pa.string() else 1 for column in names}
        episodes = [make_episode(index, version) for index in range(2)]
        return evaluations.commit(run, row | {"policy_version": version, "episodes": 2}, iter(episodes))

    return evaluated


@pytest.fixture(scope="session")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run `worked` is kept for all tests."""
    return tmp_path_factory.mktemp("shelf")


@pytest.fixture
def worked(shelf: Path, tmp_path: Path, iterate: Any, evaluate: Any) -> Run:
    """A run of three iterations and two evaluations, of this test's own."""
    if not (shelf / "worked").exists():
        kept = catalog.create(shelf, "worked", "{}", {"origin.json": b"{}"})
        for number in range(3):
            iterate(kept, number)
        for version in (1, 3):
            evaluate(kept, version)
    shutil.copytree(shelf / "worked", tmp_path / "runs" / "worked")
    return Run(tmp_path / "runs" / "worked")
