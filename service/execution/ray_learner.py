"""The learner as a Ray actor, and the supervisor's side of it.

Episodes reach it as references into the object store, which it reads without a copy; it takes what it needs of one and
lets go of it. Its fits run as Ray tasks beside it.
"""

from __future__ import annotations

import math
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import ray

from t6gps.learner.phases import Phase
from t6gps.learner.port import LearnerState, Manifest, Progress, Report
from t6gps.learner.rows import AnyArray
from t6gps.service import logs, provenance, threads
from t6gps.service.config import Config
from t6gps.service.logs import Role, Speaker
from t6gps.service.pool.deadlines import Timings
from t6gps.service.pool.pool import TICK_S
from t6gps.service.ray_backend import processes, pulse
from t6gps.service.ray_backend.cluster import Reference, start_actor
from t6gps.service.ray_backend.pulse import Pulse, Watch
from t6gps.service.ray_backend.worker_actor import Answer
from t6gps.storage import ipc, spool
from t6gps.storage.catalog import Run
from t6gps.storage.errors import LearnerDiedError, RunError, T6GpsError
from t6gps.storage.records import Episode, PolicySnapshot

Job = TypeVar("Job")
Result = TypeVar("Result")
EPISODES_PER_CALL_N = 4
"""A call costs as much as the learner's work on an episode or two."""
EPISODES_UNDER_WAY_N = 32
"""Episodes on their way to the learner. When it takes no more, sampling waits: the object store is bounded."""


class LearnerActor:
    """The learner in a process of its own."""

    def __init__(self, speaker: Speaker, config: Config) -> None:
        logs.begin(speaker)
        self._pulse = pulse.start()
        from t6gps.service.execution.wiring import new_learner  # it loads torch, which the supervisor does without

        threads.limit()
        self._learner = new_learner(config, fit_map=_task_map(config.run.workers))

    def pulse(self) -> Pulse:
        """Where its signs of life are."""
        return self._pulse

    def add(self, *answers: Answer) -> None:
        """Take episodes that lie in the object store."""
        for answer in answers:
            assert answer.packed is not None, "only episodes are streamed"
            self._take(Episode(*ipc.unpack(answer.packed, 2)))

    def add_spooled(self, files: Sequence[Path]) -> None:
        """Take episodes that lie in the spool."""
        for file in files:
            self._take(spool.read(file))

    def _take(self, episode: Episode) -> None:
        self._learner.add(episode.frames, episode.noise_std_m)

    def learn(self, phase: Phase) -> Progress:
        """What the phase yields, but not more often than somebody would look: telling costs more than some steps."""
        told_s = -math.inf
        for done, total in getattr(self._learner, phase.name)():
            if done == total or time.monotonic() - told_s >= TICK_S:
                told_s = time.monotonic()
                yield done, total

    def policy(self, version: int | None) -> PolicySnapshot:
        return self._learner.policy(version)

    def report(self) -> Report:
        return self._learner.report()

    def state(self) -> LearnerState:
        return self._learner.state()

    def restore(self, manifest: Manifest, arrays: Mapping[str, AnyArray]) -> None:
        self._learner.restore(manifest, arrays)

    def recall(self, run: Run) -> None:
        self._learner.recall(run)


class RayLearner:
    """The learner's actor, as a `LearnerPort`; every call raises LearnerDiedError when its process is gone or hangs.

    until_done   waits for a reference to be there, tends the pool, and calls `check_life` meanwhile
    """

    def __init__(self, config: Config, node: str, timings: Timings, until_done: Callable[[Reference], None]) -> None:
        self.actor = start_actor(LearnerActor, logs.other(Role.LEARNER), config, where=node)
        self._until_done, self._timings = until_done, timings
        self._started_s = time.monotonic()
        self._asked: Future[Pulse] = self.actor.pulse.remote().future()
        self._watch: Watch | None = None
        self._next: list[Reference] = []
        self._taken: list[Reference] = []

    def add(self, reference: Reference) -> None:
        """Send an episode by its reference in the object store, a few in a call; waits while too many are on their way.

        How it went is asked by `learn`: sampling continues when the learner has died.
        """
        self._next.append(reference)
        if len(self._next) == EPISODES_PER_CALL_N:
            self._send()
            if len(self._taken) > EPISODES_UNDER_WAY_N // EPISODES_PER_CALL_N:
                self._until_done(self._taken[-EPISODES_UNDER_WAY_N // EPISODES_PER_CALL_N])

    def _send(self) -> None:
        if self._next:
            self._taken.append(self.actor.add.remote(*self._next))
            self._next.clear()

    def add_spooled(self, files: Sequence[Path]) -> None:
        """Let it read episodes from the spool, while others are sampled; `learn` asks how it went."""
        self._taken.append(self.actor.add_spooled.remote([file.absolute() for file in files]))

    def learn(self, phase: Phase) -> Progress:
        """Run a phase; yields (done, total)."""
        self._send()
        if self._taken:
            self._until_done(self._taken[-1])
            taken, self._taken = self._taken, []
            self._value(taken)
        steps = self.actor.learn.options(num_returns="streaming").remote(phase)
        while True:
            self._until_done(steps)
            try:
                step = next(steps)
            except StopIteration:
                return
            yield self._answer(step)

    def policy(self, version: int | None = None) -> PolicySnapshot:
        snapshot: PolicySnapshot = self._answer(self.actor.policy.remote(version))
        return snapshot

    def report(self) -> Report:
        rows: Report = self._answer(self.actor.report.remote())
        return rows

    def state(self) -> LearnerState:
        state: LearnerState = self._answer(self.actor.state.remote())
        return state

    def restore(self, manifest: Manifest, arrays: Mapping[str, AnyArray]) -> None:
        self._answer(self.actor.restore.remote(manifest, arrays))

    def recall(self, run: Run) -> None:
        self._answer(self.actor.recall.remote(Run(run.path.absolute())))  # the actor is in another folder

    def check_life(self) -> None:
        """LearnerDiedError, and its process is ended, when it has given no sign of life for too long."""
        if self._asked.done() and self._asked.exception() is not None:
            return  # it has died, and whoever waits for it hears of that
        if self._watch is None and self._asked.done():
            self._watch = Watch(self._asked.result())
        if self._watch is None:
            silent_s, allowed_s = time.monotonic() - self._started_s, self._timings.start_s
        else:
            silent_s, allowed_s = self._watch.silent_s(), self._timings.learner_silent_s
        if silent_s > allowed_s:
            stacks = "it was never ready" if self._watch is None else processes.stacks(self._watch.pulse.process)
            self.kill()
            raise LearnerDiedError(f"the learner gave no sign of life for {silent_s:.0f} s and was ended; {stacks}")

    def kill(self) -> None:
        """End its process at once."""
        ray.kill(self.actor)
        if self._watch is not None:
            processes.kill(self._watch.pulse.process)  # a stopped process does not hear Ray

    def _answer(self, reference: Reference) -> Any:
        self._until_done(reference)
        return self._value(reference)

    def _value(self, reference: Reference) -> Any:
        """The value behind a reference, or values behind a list of them."""
        try:
            return _get(reference)
        except RunError as error:
            if isinstance(error.__cause__, ray.exceptions.ActorDiedError | ray.exceptions.ActorUnavailableError):
                raise LearnerDiedError(f"the learner's process died: {error.__cause__}") from error
            raise


def _get(reference: Reference) -> Any:
    """The value behind a reference. An error of this package comes as itself, the death of a process as RunError."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, T6GpsError):
            raise error.cause from error
        raise
    except ray.exceptions.RayError as error:
        raise RunError(
            f"a process of the run died ({type(error).__name__}); everything sampled so far is kept: resume with "
            "--resume, and with fewer --workers if memory ran out"
        ) from error


def as_at_home(function: Callable[[Job], Result], build: Mapping[str, str]) -> Callable[[Job], Result]:
    """The function as it runs in the learner's own process, wherever Ray runs it: with one thread, on the same `build`.

    RunError naming the node and what is installed there otherwise.
    """

    speaker = logs.speaker()

    def limited(job: Job) -> Result:
        if others := provenance.differences(_prepared_once(speaker), build):
            raise RunError(
                f"node {socket.gethostname()} has another installation than the run: {others}; install the same on "
                "every node, then resume with --resume"
            )
        return function(job)

    return limited


@cache
def _prepared_once(speaker: Speaker) -> Mapping[str, str]:
    """Set what holds as long as the process lives, and look at what does; both take some milliseconds."""
    logs.begin(speaker)
    threads.limit()
    return provenance.build()


def _task_map(width: int) -> Callable[..., Iterator[Any]]:
    """A `map` that runs up to `width` calls at once as Ray tasks and yields their results in order.

    The tasks claim no CPU: the workers hold the CPUs, and leave them idle while the learner works, or share them in
    a pipelined run.
    """

    build = provenance.build()

    def task_map(function: Callable[[Any], Any], jobs: Iterable[Any]) -> Iterator[Any]:
        task = ray.remote(num_cpus=0, max_retries=3)(as_at_home(function, build))
        pending: deque[Reference] = deque()
        for job in jobs:
            pending.append(task.remote(job))
            if len(pending) == width:
                yield _get(pending.popleft())
        for result in pending:
            yield _get(result)

    return task_map
