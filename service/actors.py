"""The workers, the learner and the holder of the weights, plain classes, as Ray actors: the one file that knows Ray.

Workers pull: before each episode they ask the holder for weights newer than theirs. At most two plans per worker are
under way; a plan is sent when an episode comes back. Tables travel through the object store and are read in place.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pyarrow as pa
import ray
from ray._private import services

from t6gps.service.config import Config
from t6gps.service.executor import Executor
from t6gps.service.serial import new_learner
from t6gps.storage.errors import RunError, T6GpsError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker

PLANS_PER_WORKER = 2
OBJECT_STORE_BYTES = 2 * 1024**3


class WeightsActor:
    """Holds the newest weights for whoever asks."""

    def __init__(self) -> None:
        self._snapshot: PolicySnapshot | None = None

    def publish(self, snapshot: PolicySnapshot) -> None:
        self._snapshot = snapshot

    def newer_than(self, version: int) -> PolicySnapshot | None:
        """The newest snapshot if it is newer than `version`, else None."""
        return self._snapshot if self._snapshot is not None and self._snapshot.version > version else None


class WorkerActor:
    """A rollout worker that pulls its weights."""

    def __init__(self, settings: RolloutSettings, weights: Any) -> None:
        self._worker = RolloutWorker(settings)
        self._weights = weights
        self._snapshot: PolicySnapshot | None = None

    def run(self, plan: EpisodePlan) -> tuple[pa.Table, pa.Table]:
        version = -1 if self._snapshot is None else self._snapshot.version
        self._snapshot = _get(self._weights.newer_than.remote(version)) or self._snapshot
        if self._snapshot is None or self._snapshot.version < plan.policy_version:
            raise RunError(
                f"episode {plan.episode_id} needs policy version {plan.policy_version}, "
                f"the newest is {None if self._snapshot is None else self._snapshot.version}; publish it first"
            )
        episode = self._worker.run(plan, self._snapshot)
        return episode.frames, episode.summary


class LearnerActor:
    """The learner; its fits run as tasks beside it."""

    def __init__(self, config: Config) -> None:
        self._learner = new_learner(config, fit_map=_task_map(config.run.workers))

    def add(self, frames: pa.Table) -> None:
        self._learner.add(frames)

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        yield from getattr(self._learner, phase)()

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._learner, method)(*arguments)


def _get(reference: Any) -> Any:
    """The value behind a reference. An error of this package comes as itself, the death of a process as RunError."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, T6GpsError):
            raise error.cause from error
        raise
    except ray.exceptions.RayError as error:
        raise RunError(
            f"a process of the run died ({type(error).__name__}); everything sampled so far is kept: go on with "
            "--resume, and with fewer --workers if memory ran out"
        ) from error


def _as_given(host: str) -> str:
    return host


def _start(plain: type, *arguments: Any, cpus: int = 0) -> Any:
    """A handle to an actor made from a plain class. Ray restarts none: what an actor held would be lost unnoticed."""
    return ray.remote(num_cpus=cpus, max_restarts=0)(plain).remote(*arguments)


def _task_map(width: int) -> Callable[..., Iterator[Any]]:
    """A `map` that runs up to `width` calls at once as Ray tasks and yields their results in order.

    The tasks claim no CPU: the workers, which hold the CPUs, are idle while the learner works.
    """

    def task_map(function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
        task = ray.remote(num_cpus=0, max_retries=3)(function)
        pending: list[Any] = []
        for job in jobs:
            pending.append(task.remote(job))
            if len(pending) == width:
                yield _get(pending.pop(0))
        for result in pending:
            yield _get(result)

    return task_map


class RayExecutor(Executor):
    """Workers, learner and weights as actors on Ray.

    Joins the cluster that RAY_ADDRESS names; without it, starts an embedded one on the loopback address with
    a token of its own (`t6gps.service`).
    """

    def __init__(self, config: Config) -> None:
        workers_n = config.run.workers
        if "RAY_ADDRESS" in os.environ:
            ray.init(log_to_driver=False)
        else:
            # The address below would be replaced by that of the host, and the ports opened to its network.
            services.resolve_ip_for_localhost = _as_given
            ray.init(
                address="local",
                num_cpus=max(workers_n, os.cpu_count() or 1),
                include_dashboard=False,
                log_to_driver=False,
                object_store_memory=OBJECT_STORE_BYTES,
                logging_level=logging.ERROR,
                _node_ip_address="127.0.0.1",
            )
        self._weights = _start(WeightsActor)
        self._learner = _start(LearnerActor, config)
        self._workers = [_start(WorkerActor, config.rollout, self._weights, cpus=1) for _ in range(workers_n)]
        self._newest: tuple[Episode, Any] | None = None  # an episode and the reference to its frames

    def sample(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot) -> Iterator[Episode]:
        _get(self._weights.publish.remote(snapshot))
        waiting = list(reversed(plans))
        under_way: dict[Any, tuple[Any, Any]] = {}

        def send(worker: Any) -> None:
            if waiting:
                frames, summary = worker.run.options(num_returns=2).remote(waiting.pop())
                under_way[summary] = (frames, worker)

        for _ in range(PLANS_PER_WORKER):
            for worker in self._workers:
                send(worker)
        while under_way:
            (done,), _ = ray.wait(list(under_way), num_returns=1)
            frames, worker = under_way.pop(done)
            send(worker)
            episode = Episode(_get(frames), _get(done))
            self._newest = episode, frames
            yield episode
        self._newest = None

    def add(self, episode: Episode) -> None:
        # The frames of an episode that has just been sampled are in the object store already.
        frames = episode.frames
        if self._newest is not None and self._newest[0] is episode:
            frames = self._newest[1]
        _get(self._learner.add.remote(frames))

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        for progress in self._learner.learn.options(num_returns="streaming").remote(phase):
            yield _get(progress)

    def ask(self, method: str, *arguments: Any) -> Any:
        return _get(self._learner.ask.remote(method, *arguments))

    def close(self) -> None:
        # A second Ctrl-C must not leave half of the processes behind.
        previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            ray.shutdown()
        finally:
            signal.signal(signal.SIGINT, previous)
