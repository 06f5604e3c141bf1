"""Export as a LeRobot dataset of version 3.0, which LeRobot opens, and none of its libraries is needed to write.

data/chunk-000/file-000.parquet             a row for each control step; a new file after so many bytes
meta/episodes/chunk-000/file-000.parquet    a row for each episode of that file, with its statistics
meta/info.json, meta/stats.json, meta/tasks.parquet
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from t6gps.storage import fields, schema
from t6gps.storage.delta import parquet
from t6gps.storage.exports import statistics
from t6gps.storage.exports import transitions as moves
from t6gps.storage.exports.by_run import lists
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import NUMBER, Numbered
from t6gps.storage.exports.statistics import Totals
from t6gps.storage.exports.transitions import transitions
from t6gps.storage.fields import scalar, vector
from t6gps.storage.sql.views import STEPS_PER_S

VERSION, ROBOT, TASK = "v3.0", "superball", "Roll towards the waypoint."
FILES_PER_CHUNK_N, FILE_BYTES_N = 1000, 100_000_000
"""LeRobot's own sizes; bytes count before they are compressed."""
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
COLUMNS = pa.schema(
    [
        vector("observation.state", schema.OBSERVATION_N, "1", moves.OBSERVATION_TEXT),
        vector("action", len(moves.ACTION_NAMES), "m", moves.ACTION_TEXT),
        scalar("next.reward", pa.float64(), "m2/s2", moves.REWARD_TEXT),
        scalar("next.done", pa.bool_(), "1", "the last step of the episode"),
        scalar("next.truncated", pa.bool_(), "1", moves.TRUNCATED_TEXT),
        scalar("timestamp", pa.float32(), "s", "time since the start of the episode"),
        scalar("frame_index", pa.int64(), "1", "control step of the episode"),
        NUMBER,
        scalar("index", pa.int64(), "1", "row, counted from 0 over all episodes"),
        scalar("task_index", pa.int64(), "1", "row of meta/tasks.parquet: there is one task"),
    ]
)
_PLACES = [f"{part}/{key}" for part in ("data", "meta/episodes") for key in ("chunk_index", "file_index")]
_EPISODES = pa.schema(
    [
        *(
            (name, pa.int64())
            for name in ("episode_index", "length", "dataset_from_index", "dataset_to_index", *_PLACES)
        ),
        ("tasks", pa.list_(pa.string())),
        *((f"stats/{column.name}/count", pa.list_(pa.int64())) for column in COLUMNS),
        *(
            (f"stats/{column.name}/{key}", pa.list_(pa.float64()))
            for column in COLUMNS
            for key in ("min", "max", "mean", "std", *_QUANTILES)
        ),
        schema.RUN,
        *schema.EPISODES,
    ]
)
_NAMES = {"observation.state": moves.OBSERVATION_NAMES, "action": moves.ACTION_NAMES}


@final
@dataclass
class _Written:
    """What is written so far: rows, bytes of the open file, its number, its episodes, and the statistics."""

    rows_n: int = 0
    file_n: int = 0
    file_bytes_n: int = 0
    episodes: list[dict[str, object]] = field(default_factory=list)
    totals: Totals = field(default_factory=dict)
    quantiles: dict[str, dict[str, NDArray[np.float64]]] = field(default_factory=dict)
    """Those of episodes, each times its rows."""


def write(folder: Path, name: str, episodes: Iterator[Numbered], file_bytes_n: int = FILE_BYTES_N) -> Totals:
    """Write episodes into a folder, no more than so many bytes before compression to a file; their statistics."""
    written, episodes_n = _Written(), 0
    for number, of_file in groupby(_filed(episodes, written, file_bytes_n), lambda pair: pair[0]):
        place = _FILE.format(**_place(number))
        data, meta = folder / "data" / place, folder / "meta" / "episodes" / place
        for path in (data, meta):
            path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write(data, COLUMNS, (table for _, table in of_file))
        # The first episode of the next file is already there: its turn ended this one.
        done = [row for row in written.episodes if row["data/file_index"] == number % FILES_PER_CHUNK_N]
        written.episodes = written.episodes[len(done) :]
        episodes_n += len(done)
        pq.write_table(pa.Table.from_pylist(done, _EPISODES), meta, compression="zstd", write_page_checksum=True)
    _write_meta(folder / "meta", written, episodes_n)
    return written.totals


def _filed(episodes: Iterator[Numbered], written: _Written, file_bytes_n: int) -> Iterator[tuple[int, pa.Table]]:
    """The rows of each episode, with the number of the file that they go to."""
    for numbered in episodes:
        table = _table(numbered, written.rows_n)
        if written.file_bytes_n and written.file_bytes_n + table.nbytes > file_bytes_n:
            written.file_n, written.file_bytes_n = written.file_n + 1, 0
        written.file_bytes_n += table.nbytes
        written.episodes.append(_episode(numbered, written, statistics.arrays(table)))
        written.rows_n += table.num_rows
        yield written.file_n, table


def _table(numbered: Numbered, first: int) -> pa.Table:
    """The rows of an episode, the first of which has that index."""
    moved, steps = transitions(numbered.episode), np.arange(numbered.steps)
    columns = (
        lists(moved.observations[:-1]),
        lists(moved.actions),
        pa.array(moved.rewards),
        pa.array(moved.terminated | moved.truncated),
        pa.array(moved.truncated),
        pa.array(numbered.episode.frames.column("time_s").to_numpy()[:-1].astype(np.float32)),
        pa.array(steps),
        pa.array(np.full_like(steps, numbered.index)),
        pa.array(first + steps),
        pa.array(np.zeros_like(steps)),
    )
    return pa.Table.from_arrays(columns, schema=COLUMNS)


def _episode(numbered: Numbered, written: _Written, columns: Mapping[str, NDArray[np.generic]]) -> dict[str, object]:
    """The row of an episode: LeRobot's columns, its statistics, and where it comes from. Its columns count, too."""
    place = _place(written.file_n)
    row: dict[str, object] = {
        "episode_index": numbered.index,
        "tasks": [TASK],
        "length": numbered.steps,
        "dataset_from_index": written.rows_n,
        "dataset_to_index": written.rows_n + numbered.steps,
        **{f"{part}/{key}": value for part in ("data", "meta/episodes") for key, value in place.items()},
    }
    statistics.add(written.totals, columns)
    for name, numbers in columns.items():
        found = statistics.moments(numbers).to_json()
        rows, sums = numbers.reshape(len(numbers), -1).astype(np.float64), written.quantiles.setdefault(name, {})
        for key, value in zip(_QUANTILES, np.quantile(rows, list(_QUANTILES.values()), axis=0), strict=True):
            found[key] = value.tolist()
            sums[key] = sums.get(key, 0.0) + len(numbers) * value
        row |= {f"stats/{name}/{key}": value for key, value in found.items()}
    return row | numbered.row


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // FILES_PER_CHUNK_N, "file_index": number % FILES_PER_CHUNK_N}


def _write_meta(meta: Path, written: _Written, episodes_n: int) -> None:
    info = {
        "codebase_version": VERSION,
        "robot_type": ROBOT,
        "total_episodes": episodes_n,
        "total_frames": written.rows_n,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK_N,
        "data_files_size_in_mb": FILE_BYTES_N // 10**6,
        "video_files_size_in_mb": 2 * FILE_BYTES_N // 10**6,
        "fps": int(STEPS_PER_S),
        "splits": {"train": f"0:{episodes_n}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": {column.name: _feature(column) for column in COLUMNS},
    }
    of_columns = {
        name: found.to_json() | {key: (sums / found.count[0]).tolist() for key, sums in written.quantiles[name].items()}
        for name, found in written.totals.items()
    }
    (meta / "info.json").write_text(json.dumps(info, indent=4))
    (meta / "stats.json").write_text(json.dumps(of_columns, indent=4))
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "__index_level_0__": [TASK]})
    pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(_TASKS_OF_PANDAS)}), meta / "tasks.parquet")


def _feature(column: pa.Field) -> dict[str, object]:
    length = fields.vector_length(column)
    kind = column.type if length is None else column.type.value_type
    dtype = {"double": "float64", "float": "float32"}.get(str(kind), str(kind))
    names = _NAMES.get(column.name)
    return {"dtype": dtype, "shape": [length or 1], "names": None if names is None else list(names)}


_TASKS_OF_PANDAS = {
    "index_columns": ["__index_level_0__"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": field_name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, field_name, kind, numpy_type in (
            ("task_index", "task_index", "int64", "int64"),
            (None, "__index_level_0__", "unicode", "object"),
        )
    ],
}
"""LeRobot reads the tasks with pandas, which takes from here that the texts are its index."""

FORMAT = Format(
    title="a LeRobot dataset, version 3.0",
    package="LeRobot",
    write=write,
    columns=COLUMNS,
    alignment=(
        "Row t of an episode holds state t as the policy observes it, the action taken there, and what followed. "
        "An episode of T steps has T rows."
    ),
    opening=(
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        'dataset = LeRobotDataset("local/dataset", root="{path}")\n'
    ),
    losses=(
        "The last state of each episode, which no action follows, is not there.",
        "States are there as the policy's observations; other columns of `frames` are not.",
        "LeRobot's tensors have 32 bits: of `next.reward` only the files have 64.",
    ),
    viewer="data/*/*.parquet",
    statistics="meta/stats.json",
)
