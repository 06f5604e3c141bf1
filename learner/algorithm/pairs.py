"""Observations and improved actions (GetObservationActionPairs; Algorithm 2, line 11).

Pairs are views of the rows of an iteration and become arrays where a batch of them is taken: an iteration's
observations are the largest thing that the learner holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from t6gps.learner.rows import Floats, Ints


@dataclass(frozen=True)
class Pairs:
    """m pairs, at rows [m] of observations y [n, ny] and actions u* [n, nu] (m)."""

    observation: Floats
    action: Floats
    rows: Ints

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: Ints) -> tuple[Floats, Floats]:
        """Observations [k, ny] and actions [k, nu] of some pairs [k]."""
        at = self.rows[chosen]
        return self.observation[at], self.action[at]


def every(observation: Floats, action: Floats) -> Pairs:
    """The pairs of all rows."""
    return Pairs(observation, action, np.arange(len(action)))


@dataclass(frozen=True)
class Several:
    """Pairs of several iterations, one after the other; at least one."""

    parts: Sequence[Pairs]

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def take(self, chosen: Ints) -> tuple[Floats, Floats]:
        """Observations [k, ny] and actions [k, nu] of some pairs [k]."""
        if len(self.parts) == 1:
            return self.parts[0].take(chosen)
        newest = self.parts[-1]
        observations = np.empty((len(chosen), newest.observation.shape[1]), dtype=np.float32)
        actions = np.empty((len(chosen), newest.action.shape[1]), dtype=np.float32)
        first = 0
        for part in self.parts:
            of_part = (chosen >= first) & (chosen < first + len(part))
            observations[of_part], actions[of_part] = part.take(chosen[of_part] - first)
            first += len(part)
        return observations, actions
