"""Short pieces of trajectories that are improved one by one (Sec. III-F; GetSubTrajectories, Algorithm 2, line 8)."""

from __future__ import annotations

import numpy as np

from t6gps.learner.rows import Flags, Ints

CHUNK = 64
"""Sub-trajectories solved at once: their results stay in the cache. Chunks do not depend on each other."""


def sub_trajectories(continues: Flags, horizon_steps: int) -> dict[int, Ints]:
    """First rows of all sub-trajectories by their length (paper Sec. III-F; GetSubTrajectories of Algorithm 2).

    Runs of rows that lead to the next row [n] are divided into consecutive pieces of `horizon_steps`; the
    last piece of a run may be shorter.
    """
    index = np.flatnonzero(continues)
    run = np.cumsum(np.diff(index, prepend=-2) > 1)
    age = np.arange(len(index)) - np.flatnonzero(np.diff(run, prepend=0))[run - 1]
    begins = np.flatnonzero(age % horizon_steps == 0)
    lengths = np.diff(begins, append=len(index))
    return {int(length): index[begins[lengths == length]] for length in np.unique(lengths)}


def chunks(continues: Flags, horizon_steps: int) -> list[Ints]:
    """Rows of all sub-trajectories [b, T], b <= CHUNK, those of one length together."""
    return [
        starts[first : first + CHUNK, None] + np.arange(length)
        for length, starts in sub_trajectories(continues, horizon_steps).items()
        for first in range(0, len(starts), CHUNK)
    ]
