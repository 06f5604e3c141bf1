"""Contracts between twins: serial and Ray executors, the policy in numpy and in torch."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from house import others, three_nodes
from ray.cluster_utils import Cluster

from t6gps.learner import policy as torch_policy
from t6gps.service.config import Config, load
from t6gps.service.execution.executor import Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.training import loop
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.workers.episode import policy

TINY = [
    "run.iterations=2",
    "run.episodes=5",
    "run.steps=40",
    "learner.smallest_class_segments=4",
    "learner.epochs=2",
    "learner.replay_iterations=1",
    "learner.hidden_layers=[16]",
]

PIPELINED = [*TINY, "run.iterations=3", "run.pipelined=true"]


class Silent:
    def progress(self, iteration: int, phase: str, done: int, total: int) -> None: ...

    def finished(self, row: dict[str, Any]) -> None: ...


class Kills(Silent):
    """Kills a worker at some progress of the run, and the learner while it fits the second iteration."""

    def __init__(self, executor: RayExecutor, worker_at: tuple[int, str, int]) -> None:
        self.executor, self.worker_at, self.done = executor, worker_at, set[str]()

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if (iteration, phase, done) == self.worker_at and "worker" not in self.done:
            self.done.add("worker")
            worker = next(worker for worker in self.executor.pool.state.workers.values() if worker.identity)
            os.kill(worker.identity.pid, signal.SIGKILL)
        if (iteration, phase) == (1, "fit") and "learner" not in self.done:
            self.done.add("learner")
            self.executor.learner.kill()


class Stops(Silent):
    """Stops the run while the learner is at work on the second iteration."""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if (iteration, phase) == (1, "supervise"):
            raise KeyboardInterrupt


class Loses(Silent):
    """Loses a node that has a worker in the second iteration's sampling."""

    def __init__(self, executor: RayExecutor, nodes: Cluster) -> None:
        self.executor, self.nodes, self.lost = executor, nodes, ""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if (iteration, phase) == (1, "sample") and not self.lost:
            candidates = others(self.nodes)
            used = [worker.identity.node_id for worker in self.executor.pool.state.workers.values() if worker.identity]
            self.lost = next((node for node in used if node in candidates), "")
            if self.lost:
                self.nodes.remove_node(candidates[self.lost], allow_graceful=False)


@pytest.fixture(autouse=True)
def no_ray_left_behind() -> Iterator[None]:
    yield
    assert not ray.is_initialized()


def result_of(
    config: Config, executor: Executor, root: Path, observer: loop.Observer | None = None
) -> tuple[Any, Any, list[bytes]]:
    this = catalog.create(root, f"run-{type(executor).__name__}-{config.run.workers}", config.to_json())
    return completed(config, executor, this, observer or Silent())


def completed(config: Config, executor: Executor, this: Run, observer: loop.Observer) -> tuple[Any, Any, list[bytes]]:
    try:
        loop.train(config, this, executor, observer)
    finally:
        executor.close()
    latest = checkpoint.load_latest(this.checkpoints)
    assert latest is not None
    weights = [latest[2][name].tobytes() for name in sorted(latest[2])]
    return tables.read(this, "frames"), tables.read(this, "episodes"), weights


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, list[bytes]]:
    config = load("flat-quick", TINY)
    return result_of(config, SerialExecutor(config), tmp_path_factory.mktemp("serial"))


@pytest.mark.slow
def test_t15_serial_and_ray_give_identical_episodes_and_weights(tmp_path: Path, serial: Any) -> None:
    config = load("flat-quick", [*TINY, "run.workers=1"])
    assert result_of(config, RayExecutor(config), tmp_path) == serial


@pytest.fixture(scope="module")
def pipelined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, list[bytes]]:
    config = load("flat-quick", PIPELINED)
    return result_of(config, SerialExecutor(config), tmp_path_factory.mktemp("pipelined"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "expected", "worker_at"),
    [(TINY, "serial", (1, "sample", 2)), (PIPELINED, "pipelined", (0, "fit", 1))],
    ids=["ordinary", "sampling-ahead"],
)
def test_t10_t15_a_killed_worker_and_a_killed_learner_change_no_byte(
    tmp_path: Path,
    request: pytest.FixtureRequest,
    settings: list[str],
    expected: str,
    worker_at: tuple[int, str, int],
) -> None:
    config = load("flat-quick", [*settings, "run.workers=2"])
    executor = RayExecutor(config)
    kills = Kills(executor, worker_at)
    assert result_of(config, executor, tmp_path, kills) == request.getfixturevalue(expected)
    assert kills.done == {"worker", "learner"}
    assert executor.pool.state.counters["crashed"] == 1


@pytest.mark.slow
def test_t10_t15_a_run_that_is_stopped_while_it_samples_ahead_goes_on_with_the_same_bytes(
    tmp_path: Path, pipelined: Any
) -> None:
    config = load("flat-quick", [*PIPELINED, "run.workers=2"])
    this = catalog.create(tmp_path, "stopped", config.to_json())
    with pytest.raises(KeyboardInterrupt):
        completed(config, RayExecutor(config), this, Stops())
    assert completed(config, RayExecutor(config), this, Silent()) == pipelined


@pytest.mark.slow
def test_t15_t16_three_nodes_of_which_one_dies_change_no_byte(tmp_path: Path, serial: Any) -> None:
    config = load("flat-quick", [*TINY, "run.workers=3"])
    with three_nodes() as nodes:
        executor = RayExecutor(config)
        loses = Loses(executor, nodes)
        assert result_of(config, executor, tmp_path, loses) == serial
    assert loses.lost


def test_the_policy_is_the_same_in_numpy_and_in_torch() -> None:
    rng = np.random.default_rng(0)
    snapshot = torch_policy.initial(47, 24, (256, 256, 256), rng, offset_m=1.088, scale_m=0.2)
    layers = tuple((weight * np.float32(5), bias + np.float32(0.1)) for weight, bias in snapshot.layers)
    snapshot = type(snapshot)(1, layers, snapshot.offset_m, snapshot.scale_m)
    observations = rng.standard_normal((50, 47)).astype(np.float32)
    together = torch_policy.act(snapshot, observations)
    for observation, expected in zip(observations, together, strict=True):
        assert np.allclose(policy.ready(snapshot)(observation), expected, atol=1e-6)
