"""How long the pool waits for what; for an episode, by how long others took."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

REMEMBERED_N = 200
QUANTILE = 0.95
FACTOR = 12.0
"""A worker ten times slower than the others is slow; it does not hang."""
FIRST_S, FIRST_PER_STEP_S = 60.0, 0.1
"""While nothing is measured: a minute, and the time that the robot itself would take."""


@dataclass(frozen=True, kw_only=True)
class Timings:
    """How long the pool waits (s)."""

    shortest_episode_s: float = 5.0
    """No episode has a shorter deadline."""
    start_s: float = 180.0
    """For a worker's process to be ready, once there is room for it."""
    pending_after_s: float = 3.0
    """A process needs so long to start, also where there is room for it."""
    ping_s: float = 1.0
    """Between two questions for a sign of life, to an idle worker or to the policy server."""
    ping_deadline_s: float = 20.0
    """For an idle worker's answer."""
    capacity_s: float = 1.0
    """Between two questions for room in the cluster, while somebody needs it."""
    shrink_after_s: float = 30.0
    """Autoscaling gives a worker up after it was not needed for so long: the learner's phases are shorter."""
    policy_answer_s: float = 4.0
    """For the policy server's answer. An episode has more time than that: a worker that asks is not to blame."""
    policy_start_s: float = 60.0
    """For the first answer of a policy server, whose process has to start."""
    learner_silent_s: float = 120.0
    """For the learner's sign of life, which it gives every second whatever it computes."""
    examine_s: float = 0.6
    """For another node to say what is left of a worker; it is cut off, and its node with it, when it does not."""


TIMINGS = Timings()


@dataclass
class EpisodeTimes:
    """Times of recent episodes, per control step; no deadline is shorter than `shortest_s`."""

    shortest_s: float
    per_step_s: deque[float] = field(default_factory=deque)

    def add(self, took_s: float, steps: int) -> None:
        """An episode of `steps` control steps took `took_s`."""
        self.per_step_s.append(took_s / steps)
        if len(self.per_step_s) > REMEMBERED_N:
            self.per_step_s.popleft()

    def deadline_s(self, steps: int) -> float:
        """An episode of `steps` control steps that takes longer than this hangs."""
        if not self.per_step_s:
            return FIRST_S + FIRST_PER_STEP_S * steps
        ordered = sorted(self.per_step_s)
        return max(self.shortest_s, FACTOR * ordered[int(QUANTILE * (len(ordered) - 1))] * steps)
