"""Random streams of the learner: branches (1, iteration, stream, ...) of the run's seed sequence, one per purpose."""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np

LEARNER = 1
"""First key below the run's seed; the others belong to what samples and evaluates."""


@unique
class Stream(IntEnum):
    """What a generator is for. No number comes twice: equal branches would draw equal numbers.

    FITS           subsets of the mode search, one branch per class
    SUPERVISED     order of the pairs
    UNTRAINED      weights of the first policy, in iteration 0 alone
    ACTION_VALUE   first weights of the action value, and the transitions that it learns from
    CLUSTERS       centres of k-means, where samples are localised by clusters
    """

    FITS = 0
    SUPERVISED = 1
    UNTRAINED = 2
    ACTION_VALUE = 3
    CLUSTERS = 4


def branch(iteration: int, stream: Stream, *further: int) -> tuple[int, ...]:
    """Spawn key of a stream, or of one of its parts."""
    return (LEARNER, iteration, int(stream), *further)


def generator(run_seed: int, key: tuple[int, ...]) -> np.random.Generator:
    """The generator of a branch below a run's seed."""
    return np.random.default_rng(np.random.SeedSequence(run_seed, spawn_key=key))
