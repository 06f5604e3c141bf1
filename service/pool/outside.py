"""What the pool asks of whoever stands outside: what somebody wants of it, and an ear for how it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.state import PoolState


@dataclass(frozen=True)
class Situation:
    """How the pool is: what the supervisor knows, what the run does at present, and who waits since when.

    waits_since_s, now_s   by the pool's clock (s)
    """

    state: PoolState
    phase: str
    waits_since_s: Mapping[str, float]
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
