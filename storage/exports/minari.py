"""Export as a Minari dataset in HDF5: T + 1 observations, and T actions with reward and end."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from t6gps.storage import schema
from t6gps.storage.errors import ConfigError
from t6gps.storage.exports import statistics
from t6gps.storage.exports import transitions as moves
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import Numbered
from t6gps.storage.exports.statistics import Totals
from t6gps.storage.exports.transitions import Transitions, transitions
from t6gps.storage.fields import scalar, vector

FOLDER = "data"
_NAME = re.compile(r"[A-Za-z0-9_-]+-v\d+")
_INFOS = ("com_x_m", "com_y_m", "com_z_m", "forward_speed_m_per_s", "face")
"""Columns of `frames` that every state has beside its observation."""
COLUMNS = pa.schema(
    [
        vector("observations", schema.OBSERVATION_N, "1", moves.OBSERVATION_TEXT),
        vector("actions", len(moves.ACTION_NAMES), "m", moves.ACTION_TEXT),
        scalar("rewards", pa.float64(), "m2/s2", moves.REWARD_TEXT),
        scalar("terminations", pa.bool_(), "1", moves.TERMINATED_TEXT),
        scalar("truncations", pa.bool_(), "1", moves.TRUNCATED_TEXT),
        *(schema.FRAMES.field(name).with_name(f"infos/{name}") for name in _INFOS),
    ]
)


def _write(folder: Path, name: str, episodes: Iterator[Numbered]) -> Totals:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"Minari's datasets are called NAME-v0, with a number at the end, found {name!r}; rename it")
    try:
        import minari
        from gymnasium.spaces import Box
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage
    except ImportError as error:
        raise ConfigError(f"Minari's format needs {error.name or 'h5py'}: pip install 't6gps[export]'") from None
    spaces = (Box(-np.inf, np.inf, (n,), np.float32) for n in (schema.OBSERVATION_N, len(moves.ACTION_NAMES)))
    storage = MinariStorage.new(folder / FOLDER, *spaces, data_format="hdf5")
    totals: Totals = {}
    rows: list[dict[str, object]] = []

    def buffers() -> Iterator[EpisodeBuffer]:
        for numbered in episodes:
            moved, frames = transitions(numbered.episode), numbered.episode.frames
            infos = {info: frames.column(info).to_numpy() for info in _INFOS}
            statistics.add(totals, _columns(moved) | {f"infos/{info}": column for info, column in infos.items()})
            rows.append({key: value for key, value in numbered.row.items() if value is not None})
            yield EpisodeBuffer(id=numbered.index, infos=infos, **_columns(moved))

    storage.update_episodes(buffers())
    storage.update_episode_metadata(rows)
    storage.update_metadata(
        {"dataset_id": name, "minari_version": minari.__version__, "algorithm_name": "T6-GPS", "description": TEXT}
    )
    return totals


def _columns(moved: Transitions) -> dict[str, np.ndarray]:
    return {
        "observations": moved.observations,
        "actions": moved.actions,
        "rewards": moved.rewards,
        "terminations": moved.terminated,
        "truncations": moved.truncated,
    }


TEXT = "Episodes of SUPERball, a simulated tensegrity robot; README.md has columns, units, statistics and origin."
FORMAT = Format(
    title="a Minari dataset, in a folder NAME-v0",
    package="Minari",
    write=_write,
    columns=COLUMNS,
    alignment=(
        "An episode of T steps has T + 1 observations and infos, and T actions with what followed each: "
        "`rewards[t]` is that of `actions[t]`, which led from `observations[t]` to `observations[t + 1]`."
    ),
    opening='from minari import MinariDataset\n\ndataset = MinariDataset("{path}/data")\n',
    losses=(
        "States are there as the policy's observations, with a few infos; other columns of `frames` are not.",
        "It names no environment: actions are rest lengths in metres, those of `t6gps/SuperBall-v0` lie in -1 .. 1.",
    ),
    viewer=None,
)
