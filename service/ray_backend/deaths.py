"""How often a role may die: what is replaced for ever hides its cause."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from t6gps.storage.errors import RunError

ALLOWED_N = 5
WINDOW_S = 120.0
"""Somebody who kills a role at random does so less often."""


class Deaths:
    """The latest deaths of a role."""

    def __init__(self, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._role, self._clock = role, clock
        self._at_s: deque[float] = deque()

    def add(self, cause: str) -> None:
        """The role has died, or has been ended. RunError with the cause when that is once too often."""
        now = self._clock()
        self._at_s.append(now)
        while now - self._at_s[0] > WINDOW_S:
            self._at_s.popleft()
        if len(self._at_s) > ALLOWED_N:
            raise RunError(
                f"{self._role} has failed {len(self._at_s)} times within {WINDOW_S:.0f} s; the last: {cause}; "
                "everything sampled so far is kept: look for the cause with t6gps doctor, then resume with --resume"
            )
