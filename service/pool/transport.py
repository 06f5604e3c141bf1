"""What the pool asks of whatever runs the workers: Ray (`ray_backend.transport`), or a fake in tests."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.messages import Alive, Died, PostMortem, Ready
from t6gps.service.pool.state import WorkerId
from t6gps.storage.records import Episode, EpisodePlan


@dataclass(frozen=True)
class Done:
    """An attempt is over: an episode, a failure, or None when the worker could not get the policy that it needs.

    at_s   when it came back (s, the pool's clock)
    """

    worker: WorkerId
    plan: EpisodePlan
    result: Episode | Failure | None
    at_s: float
    policy_digest: str = ""


Report = Ready | Alive | Done | Died


class Transport(ABC):
    """Starts, feeds and ends workers. No call waits for a worker."""

    @abstractmethod
    def start(self, worker: WorkerId) -> None:
        """Start a worker; a `Ready` or a `Died` follows."""

    @abstractmethod
    def send(self, worker: WorkerId, plan: EpisodePlan) -> None:
        """Queue a plan; a `Done` or a `Died` follows."""

    @abstractmethod
    def ping(self, worker: WorkerId) -> None:
        """Ask an idle worker for a sign of life; an `Alive` or a `Died` follows."""

    @abstractmethod
    def poll(self, wait_s: float) -> list[Report]:
        """Everything reported since the last call, waiting up to `wait_s` for a first report."""

    @abstractmethod
    def examine(self, worker: WorkerId) -> PostMortem:
        """Look at a worker that hangs or has died, from outside, in less than half a second."""

    @abstractmethod
    def kill(self, worker: WorkerId) -> None:
        """End a worker at once, whatever it does. Nothing is reported of it afterwards."""

    @abstractmethod
    def placed(self, worker: WorkerId) -> bool:
        """False while there is no room for a worker that was started."""

    @abstractmethod
    def ask_nodes(self, workers: int) -> None:
        """Let the cluster have room for so many workers, where it can grow, until this is called again."""

    @abstractmethod
    def free_workers(self) -> int:
        """How many more workers there is room for."""
