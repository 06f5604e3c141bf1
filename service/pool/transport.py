"""What the supervisor asks of the machinery that runs workers: `actors` answers with Ray, tests with a fake."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from t6gps.service.pool.attempt import Failure
from t6gps.storage.records import Episode, EpisodePlan

Handle = Any
"""A worker's process, whatever the transport makes of it; it can be a key."""


@dataclass(frozen=True)
class Identity:
    """Who a worker is, as it says itself when it is ready."""

    pid: int
    node: str
    settings_digest: str


@dataclass(frozen=True)
class Ready:
    """A worker has started."""

    handle: Handle
    identity: Identity


@dataclass(frozen=True)
class Alive:
    """An idle worker has answered."""

    handle: Handle


@dataclass(frozen=True)
class Done:
    """An attempt is over: an episode, a failure, or None when the worker could not get the policy it needs."""

    handle: Handle
    plan: EpisodePlan
    result: Episode | Failure | None
    policy_digest: str = ""


@dataclass(frozen=True)
class Died:
    """A worker's process has ended, or could not begin."""

    handle: Handle
    error: str
    message: str


Report = Ready | Alive | Done | Died


@dataclass(frozen=True)
class Remains:
    """What could be learned of a worker from outside before it was killed.

    blameless   somebody else ended or stopped it, or its node is gone: the episode in hand is not the cause
    """

    stacks: str = ""
    log: str = ""
    blameless: bool = False


class Transport(ABC):
    """Starts, feeds and kills workers. No call waits for a worker."""

    @abstractmethod
    def start(self, slot: int, incarnation: int) -> Handle:
        """Start a worker; a `Ready` or a `Died` follows."""

    @abstractmethod
    def send(self, handle: Handle, plan: EpisodePlan) -> None:
        """Queue a plan; a `Done` or a `Died` follows."""

    @abstractmethod
    def ping(self, handle: Handle) -> None:
        """Ask an idle worker for a sign of life; an `Alive` or a `Died` follows."""

    @abstractmethod
    def poll(self, wait_s: float) -> list[Report]:
        """Everything reported since the last call, waiting up to `wait_s` for a first report."""

    @abstractmethod
    def examine(self, handle: Handle) -> Remains:
        """Look at a worker that hangs or has died, from outside, in less than half a second."""

    @abstractmethod
    def kill(self, handle: Handle) -> None:
        """End a worker at once, whatever it does. Nothing is reported of it afterwards."""

    @abstractmethod
    def placed(self, handle: Handle) -> bool:
        """False while there is no room for a worker that was started."""

    @abstractmethod
    def free_workers(self) -> int:
        """How many more workers there is room for."""
