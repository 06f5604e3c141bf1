"""Contracts between twins: serial and Ray executors, the policy in numpy and in torch."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import torch

from t6gps.learner import policy as torch_policy
from t6gps.service import run
from t6gps.service.actors import RayExecutor
from t6gps.service.config import Config, load
from t6gps.service.executor import Executor
from t6gps.service.serial import SerialExecutor
from t6gps.storage import catalog, checkpoint, tables
from t6gps.workers import policy

TINY = [
    "run.iterations=2",
    "run.episodes=5",
    "run.steps=40",
    "learner.smallest_class_segments=4",
    "learner.epochs=2",
    "learner.hidden_layers=[16]",
]


class Silent:
    def progress(self, iteration: int, phase: str, done: int, total: int) -> None: ...

    def finished(self, row: dict[str, Any]) -> None: ...


@pytest.fixture(autouse=True)
def no_ray_left_behind() -> Iterator[None]:
    yield
    assert not ray.is_initialized()


def result_of(config: Config, executor: Executor, root: Path) -> tuple[Any, Any, list[bytes]]:
    this = catalog.create(root, f"run-{type(executor).__name__}-{config.run.workers}", config.to_json())
    try:
        run.train(config, this, executor, Silent())
    finally:
        executor.close()
    latest = checkpoint.load_latest(this.checkpoints)
    assert latest is not None
    weights = [latest[2][name].tobytes() for name in sorted(latest[2])]
    return tables.read(this, "frames"), tables.read(this, "episodes"), weights


@pytest.mark.slow
def test_serial_and_ray_with_one_and_two_workers_give_identical_episodes_and_weights(tmp_path: Path) -> None:
    config = load("flat-quick", TINY)
    serial = result_of(config, SerialExecutor(config), tmp_path)
    for workers in (1, 2):
        config = load("flat-quick", [*TINY, f"run.workers={workers}"])
        assert result_of(config, RayExecutor(config), tmp_path) == serial


def test_the_policy_is_the_same_in_numpy_and_in_torch() -> None:
    rng = np.random.default_rng(0)
    snapshot = torch_policy.initial(47, 24, (256, 256, 256), rng, offset_m=1.088, scale_m=0.2)
    layers = tuple((weight * np.float32(5), bias + np.float32(0.1)) for weight, bias in snapshot.layers)
    snapshot = type(snapshot)(1, layers, snapshot.offset_m, snapshot.scale_m)
    network = torch_policy.module(snapshot)
    for observation in rng.standard_normal((50, 47)).astype(np.float32):
        with torch.no_grad():
            expected = snapshot.offset_m + snapshot.scale_m * network(torch.from_numpy(observation)).numpy()
        assert np.allclose(policy.act(snapshot, observation), expected, atol=1e-6)
