"""Export for RLlib's offline data: Parquet with a row for each transition, in RLlib's columns."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from t6gps.storage import schema
from t6gps.storage.exports import by_run
from t6gps.storage.exports import transitions as moves
from t6gps.storage.exports.by_run import lists
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import Numbered
from t6gps.storage.exports.statistics import Totals
from t6gps.storage.exports.transitions import transitions
from t6gps.storage.fields import scalar, vector

FOLDER = "data"
COLUMNS = pa.schema(
    [
        scalar("eps_id", pa.string(), "", "run and number of the episode there, as RUN/7"),
        scalar("t", pa.int32(), "1", "control step of the episode"),
        vector("obs", schema.OBSERVATION_N, "1", moves.OBSERVATION_TEXT),
        vector("actions", len(moves.ACTION_NAMES), "m", moves.ACTION_TEXT),
        scalar("rewards", pa.float64(), "m2/s2", moves.REWARD_TEXT),
        vector("new_obs", schema.OBSERVATION_N, "1", "observation of the state that the action led to"),
        scalar("terminateds", pa.bool_(), "1", moves.TERMINATED_TEXT),
        scalar("truncateds", pa.bool_(), "1", moves.TRUNCATED_TEXT),
    ]
)


def _write(folder: Path, name: str, episodes: Iterator[Numbered]) -> Totals:
    return by_run.write(folder / FOLDER, COLUMNS, episodes, _table)


def _table(numbered: Numbered) -> pa.Table:
    moved = transitions(numbered.episode)
    columns = (
        pa.repeat(f"{numbered.run}/{numbered.episode.episode_id}", numbered.steps),
        pa.array(np.arange(numbered.steps), pa.int32()),
        lists(moved.observations[:-1]),
        lists(moved.actions),
        pa.array(moved.rewards),
        lists(moved.observations[1:]),
        pa.array(moved.terminated),
        pa.array(moved.truncated),
    )
    return pa.Table.from_arrays(columns, schema=COLUMNS)


FORMAT = Format(
    title="offline data of RLlib",
    package="RLlib",
    write=_write,
    columns=COLUMNS,
    alignment=(
        "Row t of an episode holds observation t, the action taken there, and what followed: the reward and "
        "observation t + 1. An episode of T steps has T rows."
    ),
    opening=(
        "from ray.rllib.algorithms.bc import BCConfig\n\n"
        'config = BCConfig().offline_data(input_=["{path}/data"], input_read_method="read_parquet")\n'
    ),
    losses=(
        "States are there as the policy's observations; other columns of `frames` are not.",
        "RLlib's tensors have 32 bits: of `rewards` only the files have 64.",
    ),
    viewer="data/*.parquet",
)
