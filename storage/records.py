"""What crosses from one room to another beside Arrow tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PolicySnapshot:
    """The noise-free policy u = offset + scale * network(observation), ready to act with.

    version     0 for the untrained policy, then the number of learner iterations behind it
    layers      (weight [n_out, n_in], bias [n_out]) float32 per layer; tanh between layers, none after the last
    offset_m    rest length that a zero output stands for (m)
    scale_m     rest length per unit of output (m)
    """

    version: int
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    offset_m: float
    scale_m: float


@dataclass(frozen=True)
class EpisodePlan:
    """Everything that an episode's data depends on, apart from the policy and the robot's settings.

    episode_id        unique in its run
    iteration, index  place of the episode in the run
    seed              root of the episode's random streams: start, waypoints, exploration
    steps             control steps T; the episode has T + 1 rows
    terrain_seed, terrain_difficulty     ground, 0 is flat and 1 the paper's roughness
    noise_std_m       standard deviation of the exploration noise per cable (m); 0 for an evaluation
    policy_version    the oldest policy that may act in this episode
    within_reach      noise departs from what winches reach of a command in a step, anew in each; else from all of it
    """

    episode_id: int
    iteration: int
    index: int
    seed: int
    steps: int
    terrain_seed: int
    terrain_difficulty: float
    noise_std_m: float
    policy_version: int
    within_reach: bool = False


@dataclass(frozen=True)
class Episode:
    """One recorded episode: `frames` with T + 1 rows and `summary` with one row (schemas in `schema`).

    packed    both tables as one piece of memory (`ipc.pack`), where they lie in one
    """

    frames: pa.Table
    summary: pa.Table
    packed: pa.Buffer | None = None

    @property
    def episode_id(self) -> int:
        """Its number in the run."""
        return int(self.summary.column("episode_id")[0].as_py())

    @property
    def noise_std_m(self) -> float:
        """Exploration noise per cable that it was planned with (m)."""
        return float(self.summary.column("noise_std_m")[0].as_py())

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        return int(self.frames.nbytes if self.packed is None else self.packed.size)


@dataclass(frozen=True)
class Learned:
    """What the learner's work on an iteration adds to the tables.

    iteration   the row of `iterations`
    classes     rows of `classes`
    models      rows of `models`
    policies    those that are new
    """

    iteration: Mapping[str, object]
    classes: Sequence[Mapping[str, object]]
    models: pa.Table
    policies: Sequence[PolicySnapshot]
