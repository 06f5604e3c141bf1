"""One attempt at one episode, checked at the worker's boundary; what goes wrong comes back as a record."""

from __future__ import annotations

import hashlib
import logging
import traceback
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.storage.spool import checked

_log = logging.getLogger(__name__)


class FailureKind(StrEnum):
    """How an attempt at an episode fails."""

    RAISED = "raised"
    """In the worker, as an exception."""
    CRASH = "crash"
    """The worker's process ended by a fault of its own."""
    HANG = "hang"
    """No result before the deadline."""
    LOST = "lost"
    """The process was killed or stopped from outside, or its node is gone: it is not the episode's fault."""


@dataclass(frozen=True)
class Failure:
    """Why an attempt at an episode gave no data.

    error    type of the exception, or how the process ended
    trace    traceback, or the stacks of a process that hung, as far as they could be had
    step     control step that was being taken, None when unknown
    states   the last states before it, as plain numbers
    log      the end of what the process wrote
    """

    kind: FailureKind
    error: str
    message: str
    seed: int
    step: int | None = None
    trace: str = ""
    states: list[dict[str, Any]] = field(default_factory=list)
    worker: str = ""
    log: str = ""

    def __str__(self) -> str:
        place = "" if self.step is None else f", step {self.step}"
        return f"{self.error}: {self.message} (seed {self.seed}{place})"


class Runner(Protocol):
    """Whatever runs plans: a simulated robot, or a stub in tests and benchmarks."""

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode: ...

    def position(self) -> tuple[int, list[dict[str, Any]]]:
        """Control step of the episode being run, and its last states."""

    def close(self) -> None: ...


def attempt(worker: Runner, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode | Failure:
    """Run the plan with exactly the policy it names; the episode is checked here, once."""
    try:
        if snapshot.version != plan.policy_version:
            raise DataError(
                f"episode {plan.episode_id} is planned for policy version {plan.policy_version}, "
                f"found {snapshot.version}; publish the one it names"
            )
        episode = checked(worker.run(plan, snapshot), plan.iteration)
        if (found := episode.summary["episode_id"][0].as_py()) != plan.episode_id:
            raise DataError(f"episode {plan.episode_id} was asked for, the worker gave episode {found}")
    except Exception as error:  # whatever a simulator raises, the run continues
        step, states = worker.position()
        trace = "".join(traceback.format_exception(error))
        failure = Failure(FailureKind.RAISED, type(error).__name__, str(error), plan.seed, step, trace, states)
        _log.error("an attempt at episode %d has failed: %s", plan.episode_id, failure)
        return failure
    return episode


def policy_digest(snapshot: PolicySnapshot) -> str:
    """SHA-256 of everything that a policy's actions depend on."""
    digest = hashlib.sha256(f"{snapshot.version} {snapshot.offset_m!r} {snapshot.scale_m!r}".encode())
    for arrays in snapshot.layers:
        for array in arrays:
            digest.update(f"{array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()


def settings_digest(text: str) -> str:
    """SHA-256 of settings written as JSON."""
    return hashlib.sha256(text.encode()).hexdigest()
