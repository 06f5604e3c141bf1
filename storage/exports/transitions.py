"""An episode as reinforcement learning has it: T + 1 observations, and T actions with what followed each.

    o_t, u_t     observation of state t [83] (1); action taken there, commanded rest lengths [24] (m)
    r_t          reward of that action: minus the running cost of state t + 1, which it led to (m2/s2)

No episode terminates: one ends after its planned steps, or just before a state that is not sound, which is not
recorded. So its last transition is truncated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.storage.records import Episode
from t6gps.storage.schema import FRAMES

OBSERVATION_NAMES = (
    "kind",
    *(f"rest_length_{cable}" for cable in range(24)),
    *(f"bar_{bar}_angular_velocity_{axis}" for bar in range(6) for axis in "xyz"),
    *(f"{which}_direction_{axis}" for which in ("target", "track") for axis in "xy"),
    *(f"node_{node}_{axis}" for node in range(12) for axis in "xyz"),
)
"""What the entries of an observation are called."""
ACTION_NAMES = tuple(f"rest_length_{cable}" for cable in range(24))
"""What the entries of an action are called."""

OBSERVATION_TEXT = FRAMES.field("observation").metadata[b"description"].decode()
ACTION_TEXT = FRAMES.field("action").metadata[b"description"].decode()
REWARD_TEXT = "reward of the action: minus the running cost of the state that it led to"
TERMINATED_TEXT = "the task ended there; never, since a state that is not sound is not recorded"
TRUNCATED_TEXT = "the episode ended there, after its planned steps or before a state that is not sound"


@dataclass(frozen=True)
class Transitions:
    """Arrays of an episode: observations [T + 1, 83], actions [T, 24], rewards, terminated and truncated [T]."""

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def transitions(episode: Episode) -> Transitions:
    """Those of an episode."""
    frames, steps_n = episode.frames, episode.frames.num_rows - 1
    last = np.arange(steps_n) == steps_n - 1
    return Transitions(
        observations=schema.array(frames, "observation").astype(np.float32, copy=False),
        actions=schema.array(frames, "action").astype(np.float32, copy=False),
        rewards=-schema.array(frames, "cost")[1:].astype(np.float64, copy=False),
        terminated=np.zeros(steps_n, bool),
        truncated=last,
    )
