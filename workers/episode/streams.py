"""Random streams of an episode: a branch of its seed for each purpose, so that one may change without the others."""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """What a generator is for. No number comes twice: equal branches would draw equal numbers.

    START         place, orientation and shape
    COURSE        waypoints
    EXPLORATION   noise on the commands
    ROBOT         mass, stiffness, friction, winches and delay, where they are randomised
    SENSORS       noise of the sensors
    BIAS          their errors that last
    """

    START = 0
    COURSE = 1
    EXPLORATION = 2
    ROBOT = 3
    SENSORS = 4
    BIAS = 5


def generator(seed: int, stream: Stream) -> np.random.Generator:
    """The generator of a stream below an episode's seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(stream),)))
