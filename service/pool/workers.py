"""What the supervisor knows of a worker, and what it remembers of a slot from one worker to the next."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from t6gps.service.pool.transport import Handle, Identity
from t6gps.storage.records import EpisodePlan

FIRST_BACK_OFF_S, LONGEST_BACK_OFF_S = 0.5, 30.0


@dataclass
class Worker:
    """An incarnation of a slot. `plans` are its leases in their order: it is at work on the first."""

    slot: int
    incarnation: int
    handle: Handle
    since_s: float
    phase: str = "starting"
    identity: Identity | None = None
    plans: deque[EpisodePlan] = field(default_factory=deque)
    draining: bool = False
    placed: bool = True
    pinged_s: float = -math.inf
    answered: bool = True
    deadline_s: float = math.inf

    def __str__(self) -> str:
        return f"slot {self.slot}, incarnation {self.incarnation}"

    def status(self, now: float) -> dict[str, Any]:
        """Its line in `t6gps status`; ages in seconds."""
        return {
            "slot": self.slot,
            "incarnation": self.incarnation,
            "pid": self.identity and self.identity.pid,
            "node": self.identity and self.identity.node,
            "phase": "draining" if self.draining else self.phase,
            "for_s": round(now - self.since_s, 3),
            "episodes": [plan.episode_id for plan in self.plans],
        }


@dataclass
class Slot:
    """What is remembered of a slot from one incarnation to the next."""

    incarnations_n: int = 0
    failures_n: int = 0
    retry_s: float = -math.inf

    def failed(self, now: float) -> None:
        """A worker has failed here: the first time costs nothing, then each wait is twice as long as the last."""
        self.failures_n += 1
        if self.failures_n > 1:
            self.retry_s = now + min(FIRST_BACK_OFF_S * 2 ** (self.failures_n - 2), LONGEST_BACK_OFF_S)
