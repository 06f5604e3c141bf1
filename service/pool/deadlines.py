"""How long an episode may take, from how long others took."""

from __future__ import annotations

from collections import deque

REMEMBERED_N = 200
QUANTILE = 0.95
FACTOR = 12.0
"""A worker ten times slower than the others is slow; it does not hang."""
SHORTEST_S = 5.0
FIRST_S, FIRST_PER_STEP_S = 60.0, 0.1
"""While nothing is measured: a minute, and the time that the robot itself would take."""


class EpisodeTimes:
    """Times of recent episodes, per control step."""

    def __init__(self) -> None:
        self._per_step_s: deque[float] = deque(maxlen=REMEMBERED_N)

    def add(self, took_s: float, steps: int) -> None:
        """An episode of `steps` control steps took `took_s`."""
        self._per_step_s.append(took_s / steps)

    def deadline_s(self, steps: int) -> float:
        """An episode of `steps` control steps that takes longer than this hangs."""
        if not self._per_step_s:
            return FIRST_S + FIRST_PER_STEP_S * steps
        ordered = sorted(self._per_step_s)
        return max(SHORTEST_S, FACTOR * ordered[int(QUANTILE * (len(ordered) - 1))] * steps)
