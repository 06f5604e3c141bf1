"""The executor that runs workers, learner and weights as Ray actors.

Ray restarts nothing: `pool` replaces workers, `weights` the holder of the weights, `run` the learner.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import ray

from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.pool import control
from t6gps.service.pool.attempt import policy_digest, settings_digest
from t6gps.service.pool.control import Control
from t6gps.service.pool.supervisor import Pool
from t6gps.service.ray_backend import channel, cluster
from t6gps.service.ray_backend.channel import Address, Hub
from t6gps.service.ray_backend.cluster import start_actor
from t6gps.service.ray_backend.transport import MakeWorker, RayTransport
from t6gps.storage import spool
from t6gps.storage.catalog import Run
from t6gps.storage.errors import LearnerDiedError, RunError, T6GpsError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.worker import RolloutWorker


class LearnerActor:
    """The learner; its fits run as tasks beside it."""

    def __init__(self, config: Config) -> None:
        from t6gps.service.execution.serial import (
            new_learner,  # it loads torch, and the other actors live in this module too
        )

        self._learner = new_learner(config, fit_map=_task_map(config.run.workers))

    def rest(self, until_cut: Address) -> None:
        """Do nothing until that line is cut: to wait for calls costs a hundredth of a core (`weights`)."""
        with suppress(EOFError, OSError), channel.connect(until_cut) as line:
            channel.receive(line)

    def add(self, kept: Sequence[Path]) -> None:
        for path in kept:
            self._learner.add(spool.read(path).frames)

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        """What the phase yields, but not more often than somebody would look: telling costs more than some steps."""
        told_s = -math.inf
        for done, total in getattr(self._learner, phase)():
            if done == total or time.monotonic() - told_s >= control.TICK_S:
                told_s = time.monotonic()
                yield done, total

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


def _task_map(width: int) -> Callable[..., Iterator[Any]]:
    """A `map` that runs up to `width` calls at once as Ray tasks and yields their results in order.

    The tasks claim no CPU: the workers hold the CPUs, and leave them idle while the learner works, or share them in
    a pipelined run.
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

    def __init__(self, config: Config, run: Run | None = None, make_worker: MakeWorker = RolloutWorker) -> None:
        super().__init__(config, run)
        most = cluster.join_or_start(config)
        self._hub = Hub(ray.util.get_node_ip_address())  # type: ignore[no-untyped-call]
        self._transport = RayTransport(self._hub, make_worker, config.rollout, config.run.cpus_per_worker)
        self.pool = Pool(
            self._transport,
            self.ledger,
            config.run.workers,
            settings_digest(config.rollout.model_dump_json()),
            Control(run, most),
            self._quarantine,
            autoscale=config.run.autoscale,
        )
        self._learner: Any = None
        self._resting: Address | None = None  # the line that is cut to wake the learner
        self._keep: Callable[[Episode], None] | None = None  # while the workers sample ahead
        self._tend()

    def sample(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: str = "episode"
    ) -> Iterator[Episode]:
        self._begin(plans, snapshot, purpose, None)
        if self._learner is not None and self._resting is None:
            self._resting = self._hub.open()
            self._learner.rest.remote(self._resting)
        return self.pool.arrivals()

    def sample_ahead(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Callable[[Episode], None]
    ) -> None:
        self._begin(plans, snapshot, "episode", keep)

    def _begin(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        purpose: str,
        keep: Callable[[Episode], None] | None,
    ) -> None:
        self._open(plans, snapshot, purpose)
        self._transport.publish(snapshot)
        self.pool.open({version: policy_digest(held) for version, held in self._snapshots.items()})
        self._keep = keep

    def hand_over(self, kept: Sequence[Path]) -> None:
        self._answer(self._of_learner.add.remote(kept))

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        self.pool.phase = phase
        steps = self._of_learner.learn.options(num_returns="streaming").remote(phase)
        while True:
            self._await(steps)
            try:
                step = next(steps)
            except StopIteration:
                return
            yield self._answer(step)

    def ask(self, method: str, *arguments: Any) -> Any:
        return self._answer(self._of_learner.ask.remote(method, *arguments))

    def replace_learner(self) -> None:
        if self._learner is not None:
            ray.kill(self._learner)
        self._learner = None

    def close(self) -> None:
        if not ray.is_initialized():
            return
        # A second Ctrl-C must not leave half of the processes behind.
        previous = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self.pool.close(*(("DONE", "") if self.finished else ("STOPPING", "the run was stopped")))
        finally:
            self._hub.close()
            ray.shutdown()
            for number, handler in previous.items():
                signal.signal(number, handler)

    @property
    def _of_learner(self) -> Any:
        """The learner's actor, started when it is first needed, and woken."""
        if self._resting is not None:
            self._hub.cut(self._resting.number)
            self._resting = None
        if self._learner is None:
            self._learner = start_actor(LearnerActor, self.config, where=cluster.this_node())
        return self._learner

    def _answer(self, reference: Any) -> Any:
        """What the learner answers; the pool is tended meanwhile. LearnerDiedError when its process is gone."""
        self._await(reference)
        try:
            return _get(reference)
        except RunError as error:
            if isinstance(error.__cause__, ray.exceptions.ActorDiedError | ray.exceptions.ActorUnavailableError):
                raise LearnerDiedError(f"the learner's process died: {error.__cause__}") from error
            raise

    def _await(self, reference: Any) -> None:
        self.pool.wait("the run", "the learner", True)
        while not ray.wait([reference], timeout=control.TICK_S)[0]:
            self._tend()
        self.pool.wait("the run", "the learner", False)
        self._tend()

    def _tend(self) -> None:
        """Let the pool work, but not all the time, and keep what was sampled ahead."""
        if time.monotonic() - self.pool.ticked_s < control.TICK_S:
            return
        self.pool.tick()
        if self._keep is not None:
            for episode in self.pool.arrived():
                self._keep(episode)
