"""Contracts between twins: serial and Ray executors, the policy in numpy and in torch."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from house import joining, others, three_nodes
from ray.cluster_utils import Cluster
from run_digest import digests
from tiny_run import TINY, Trained, Watcher

from t6gps.learner import policy as torch_policy
from t6gps.service.config import Config, load
from t6gps.service.execution.executor import Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.monitoring.metrics import RUN_PHASES
from t6gps.service.training import evaluation, loop, session
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.workers.episode import policy

PIPELINED = [*TINY, "run.pipelined=true"]


class Kills(Watcher):
    """Kills a worker at some progress of the run, and the learner while it fits the second iteration."""

    def __init__(self, executor: RayExecutor, worker_at: tuple[int, str, int]) -> None:
        super().__init__()
        self.executor, self.worker_at, self.done = executor, worker_at, set[str]()

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if (iteration, phase, done) == self.worker_at and "worker" not in self.done:
            self.done.add("worker")
            worker = next(worker for worker in self.executor.pool.state.workers.values() if worker.identity)
            os.kill(worker.identity.pid, signal.SIGKILL)
        if (iteration, phase) == (1, "fit") and "learner" not in self.done:
            self.done.add("learner")
            self.executor.learner.kill()


class Stops(Watcher):
    """Stops the run while the learner is at work on the second iteration."""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if (iteration, phase) == (1, "supervise"):
            raise KeyboardInterrupt


class Loses(Watcher):
    """Loses a node that has a worker in the second iteration's sampling."""

    def __init__(self, executor: RayExecutor, nodes: Cluster) -> None:
        super().__init__()
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


def result_of(config: Config, executor: Executor, root: Path, observer: loop.Observer | None = None) -> dict[str, str]:
    """Digests of a new run."""
    return completed(config, executor, catalog.create(root, "run", config.to_json()), observer or Watcher())


def completed(config: Config, executor: Executor, run: Run, observer: loop.Observer) -> dict[str, str]:
    """Digests of a run, once it has what it is missing."""
    try:
        loop.train(config, run, executor, observer)
    finally:
        executor.close()
    return digests(run.path)


@pytest.fixture(scope="module")
def serial(tiny: Trained) -> dict[str, str]:
    """Digests of the serial run of TINY, without its evaluation."""
    return {part: digest for part, digest in tiny.digests.items() if not part.startswith("evaluation")}


@pytest.mark.slow
def test_t15_serial_and_ray_give_identical_episodes_and_weights(
    ray_head: dict[str, str], tmp_path: Path, serial: dict[str, str]
) -> None:
    config = load("flat-quick", [*TINY, "run.workers=1"])
    with joining(ray_head):
        executor = RayExecutor(config)
    assert result_of(config, executor, tmp_path) == serial
    assert executor.pool.phases.spent_s().keys() == set(RUN_PHASES), "what is told of a run is what the metrics know"


@pytest.fixture(scope="module")
def pipelined(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    config = load("flat-quick", PIPELINED)
    return result_of(config, SerialExecutor(config), tmp_path_factory.mktemp("pipelined"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "expected", "worker_at"),
    [(TINY, "serial", (1, "sample", 2)), (PIPELINED, "pipelined", (0, "fit", 1))],
    ids=["ordinary", "sampling-ahead"],
)
def test_t10_t15_a_killed_worker_and_a_killed_learner_change_no_byte(
    ray_head: dict[str, str],
    tmp_path: Path,
    request: pytest.FixtureRequest,
    settings: list[str],
    expected: str,
    worker_at: tuple[int, str, int],
) -> None:
    config = load("flat-quick", [*settings, "run.workers=2"])
    with joining(ray_head):
        executor = RayExecutor(config)
    kills = Kills(executor, worker_at)
    assert result_of(config, executor, tmp_path, kills) == request.getfixturevalue(expected)
    assert kills.done == {"worker", "learner"}
    assert executor.pool.state.counters["crashed"] == 1


class KillsAtTheEnd(Watcher):
    """Kills the learner when the last iteration is committed."""

    def __init__(self, executor: RayExecutor, iterations: int) -> None:
        super().__init__()
        self.executor, self.iterations, self.killed_n = executor, iterations, 0

    def finished(self, row: dict[str, Any]) -> None:
        super().finished(row)
        if len(self.rows) == self.iterations:
            self.executor.learner.kill()
            self.killed_n += 1


@pytest.mark.slow
def test_t10_a_learner_that_dies_before_the_evaluation_is_replaced(
    ray_head: dict[str, str], tmp_path: Path, tiny: Trained
) -> None:
    config = load("flat-quick", [*TINY, "run.workers=2"])
    run = catalog.create(tmp_path, "run", config.to_json())
    with joining(ray_head), closing(RayExecutor(config)) as executor:
        kills = KillsAtTheEnd(executor, config.run.iterations)
        result = session.train_and_evaluate(config, run, executor, kills)
    assert kills.killed_n == 1
    assert result == evaluation.kept(tiny.run)


@pytest.mark.slow
def test_t10_t15_a_run_that_is_stopped_while_it_samples_ahead_goes_on_with_the_same_bytes(
    ray_head: dict[str, str], tmp_path: Path, pipelined: dict[str, str]
) -> None:
    config = load("flat-quick", [*PIPELINED, "run.workers=2"])
    run = catalog.create(tmp_path, "stopped", config.to_json())
    with joining(ray_head):
        with pytest.raises(KeyboardInterrupt):
            completed(config, RayExecutor(config), run, Stops())
        assert completed(config, RayExecutor(config), run, Watcher()) == pipelined


@pytest.mark.slow
@pytest.mark.ray
def test_t15_t16_three_nodes_of_which_one_dies_change_no_byte(tmp_path: Path, serial: dict[str, str]) -> None:
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
