"""What every room's tests share: one thread per library, synthetic episodes, a trained run, a Ray to join, marks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import house
import numpy as np
import object_stores
import pyarrow as pa
import pytest
import tiny_run
from tiny_run import Trained

from t6gps.__main__ import use_one_thread
from t6gps.service import threads
from t6gps.storage import fields, schema
from t6gps.storage.objects import place
from t6gps.storage.objects.place import ObjectPath
from t6gps.storage.records import Episode

threads.limit()  # of the libraries that are loaded
use_one_thread()  # of those to come, and in other processes
IMPLIED_MARKS = {"ray_head": "ray", "nodes": "ray", "hosts": "ray", "tiny": "slow", "pair": "slow"}
"""Marks of the tests that need a fixture."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests after what their fixtures need."""
    for item in items:
        for fixture, mark in IMPLIED_MARKS.items():
            if fixture in getattr(item, "fixturenames", ()):
                item.add_marker(mark)


def _column(field: pa.Field, rows: int, rng: np.random.Generator) -> pa.Array:
    """Random values of a field; any bit pattern of a finite float may appear, also -0.0 and denormals."""
    length = fields.vector_length(field)
    size = rows * (length or 1)
    leaf = field.type.value_type if length else field.type
    if pa.types.is_floating(leaf):
        dtype = leaf.to_pandas_dtype()
        numbers = rng.normal(size=size).astype(dtype)
        special = np.array([-0.0, 0.0, np.finfo(dtype).smallest_subnormal, -np.finfo(dtype).max], dtype)
        chosen = rng.random(size) < 0.1
        numbers[chosen] = rng.choice(special, chosen.sum())
        flat = pa.array(numbers, leaf)
    elif pa.types.is_string(leaf):
        flat = pa.array(["completed"] * size, leaf)
    else:
        flat = pa.array(rng.integers(0, 20, size), leaf)
    if length is None:
        return pa.array([*flat.to_pylist()[:-1], None], leaf) if field.nullable else flat
    ends = np.arange(rows + 1) * length
    if field.nullable:  # actions: null in the last row
        ends[-1] = ends[-2]
        return pa.ListArray.from_arrays(ends, flat, field.type, mask=pa.array(np.arange(rows) == rows - 1))
    return pa.ListArray.from_arrays(ends, flat, field.type)


def _table(definition: pa.Schema, rows: int, given: dict[str, Any], rng: np.random.Generator) -> pa.Table:
    columns = [
        pa.array(np.broadcast_to(given[field.name], rows), field.type)
        if field.name in given
        else _column(field, rows, rng)
        for field in definition
    ]
    return pa.Table.from_arrays(columns, schema=definition)


def _make_episode(episode_id: int, iteration: int, steps: int = 5, rng: np.random.Generator | None = None) -> Episode:
    rng = rng or np.random.default_rng([episode_id, iteration])
    identity: dict[str, Any] = {
        "episode_id": episode_id,
        "iteration": iteration,
        "policy_version": iteration,
    }
    frames = _table(schema.FRAMES, steps + 1, {**identity, "step": np.arange(steps + 1)}, rng)
    summary = _table(schema.EPISODES, 1, {**identity, "steps": steps, "index": episode_id % 100}, rng)
    return Episode(
        fields.check(frames, schema.FRAMES, "synthetic frames"),
        fields.check(summary, schema.EPISODES, "synthetic summary"),
    )


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., Episode]:
    """A factory of random episodes: make_episode(episode_id, iteration, steps=5, rng=None)."""
    return _make_episode


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., None]:
    """wait_until(condition, seconds) returns as soon as `condition()` holds and fails when it still does not then."""

    def wait(condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"still not so after {seconds} s"
            time.sleep(0.02)  # other processes bring the condition about: there is nothing to wait on but the clock

    return wait


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A finished run; no test changes it."""
    return tiny_run.train(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def seaweed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[object_stores.Store]:
    """SeaweedFS, which a test that kills it starts again."""
    with object_stores.seaweed(tmp_path_factory.mktemp("seaweed")) as store:
        yield store


@pytest.fixture
def objects(
    seaweed: object_stores.Store, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> ObjectPath:
    """A root in SeaweedFS that no other test uses; the variables AWS_* lead to it meanwhile."""
    for name, value in seaweed.environment.items():
        monkeypatch.setenv(name, value)
    return place.whole(Path(f"s3://{object_stores.BUCKET}/{request.node.name.partition('[')[0]}"))


@pytest.fixture(scope="session")
def ray_head() -> Iterator[dict[str, str]]:
    """The variables that lead to a Ray of two CPUs, which tests join and leave as it is; see `house.joining`."""
    with house.started([2]) as (_, environment):
        yield environment
