"""What the pool asks of whoever stands outside: what somebody wants of it, and an ear for how it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.state import PoolState


class Phases:
    """What the run does at present, and how long it has done each of what it did (s).

    at   the present phase: starting, sampling, a phase of the learner, or commit
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.at, self._clock, self._since_s = "starting", clock, clock()
        self._spent_s: dict[str, float] = {}

    def enter(self, phase: str) -> None:
        """Come to another phase, or stay in this one."""
        self._spent_s, self.at, self._since_s = self.spent_s(), phase, self._clock()

    def spent_s(self) -> dict[str, float]:
        """The time in each phase until now (s)."""
        now_s = self._spent_s.get(self.at, 0.0) + self._clock() - self._since_s
        return self._spent_s | {self.at: now_s}


@dataclass(frozen=True)
class Situation:
    """How the pool is: what the supervisor knows, what the run does at present, and who waits since when.

    phases_s                           the time in each phase (s)
    waits_since_s, durable_s, now_s    by the pool's clock (s); `durable_s` is when the newest episode became so
    """

    state: PoolState
    phase: str
    phases_s: Mapping[str, float]
    waits_since_s: Mapping[str, float]
    durable_s: float | None
    now_s: float


class Outside(ABC):
    """Asks something of the pool, and is told what becomes of it. No call waits."""

    @abstractmethod
    def asked(self) -> list[Observation]:
        """What somebody newly asks for."""

    @abstractmethod
    def decided(self, situation: Situation, observed: Sequence[Observation], decided: Sequence[Instruction]) -> None:
        """A round was decided, and is about to be carried out."""

    @abstractmethod
    def told(self, situation: Situation, at_once: bool = False) -> None:
        """How the pool is: ten times a second, and `at_once` when its condition has changed."""

    @abstractmethod
    def ended(self, situation: Situation) -> None:
        """The pool is closed."""


class Nobody(Outside):
    """Where nobody is there to ask or to be told: an evaluation, a benchmark."""

    def asked(self) -> list[Observation]:
        return []

    def decided(self, situation: Situation, observed: Sequence[Observation], decided: Sequence[Instruction]) -> None:
        """Nothing to do."""

    def told(self, situation: Situation, at_once: bool = False) -> None:
        """Nothing to do."""

    def ended(self, situation: Situation) -> None:
        """Nothing to do."""
