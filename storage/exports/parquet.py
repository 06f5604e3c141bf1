"""Export as plain Parquet: every column of every frame, bit for bit, a file for each run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from t6gps.storage import schema
from t6gps.storage.exports import by_run
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import NUMBER, Numbered
from t6gps.storage.exports.statistics import Totals

FOLDER = "frames"
COLUMNS = pa.schema([NUMBER, schema.RUN, *schema.FRAMES], schema.FRAMES.metadata)


def _write(folder: Path, name: str, episodes: Iterator[Numbered]) -> Totals:
    return by_run.write(folder / FOLDER, COLUMNS, episodes, _table)


def _table(numbered: Numbered) -> pa.Table:
    frames = numbered.episode.frames
    first = [pa.repeat(pa.scalar(numbered.index, pa.int64()), len(frames)), pa.repeat(numbered.run, len(frames))]
    return pa.Table.from_arrays([*first, *frames.columns], schema=COLUMNS)


FORMAT = Format(
    title="plain Parquet, with every column",
    package="Parquet",
    write=_write,
    columns=COLUMNS,
    alignment=(
        "Row t of an episode holds state t and the action taken there; `cost` is that of state t. "
        "An episode of T steps has T + 1 rows, and in the last one `action` and `action_mean` are null."
    ),
    opening='import pyarrow.parquet as pq\n\nframes = pq.read_table("{path}/frames")\n',
    losses=(),
    viewer="frames/*.parquet",
)
