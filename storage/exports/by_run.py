"""Episodes as Parquet, a file for each run; statistics are counted on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.delta import parquet
from t6gps.storage.exports import statistics
from t6gps.storage.exports.selection import Numbered
from t6gps.storage.exports.statistics import Totals


def write(
    folder: Path, columns: pa.Schema, episodes: Iterator[Numbered], table: Callable[[Numbered], pa.Table]
) -> Totals:
    """Write RUN.parquet into a new folder, with a row group for the `table` of each episode; the statistics of it."""
    totals: Totals = {}

    def counted(numbered: Numbered) -> pa.Table:
        rows = table(numbered)
        statistics.add(totals, statistics.arrays(rows))
        return rows

    folder.mkdir()
    for run, of_run in groupby(episodes, lambda numbered: numbered.run):
        parquet.write(folder / f"{run}.parquet", columns, map(counted, of_run))
    return totals


def lists(rows: NDArray[np.float32]) -> pa.Array:
    """Rows [n, k] as a column of lists."""
    ends = np.arange(len(rows) + 1, dtype=np.int32) * rows.shape[1]
    return pa.ListArray.from_arrays(ends, pa.array(rows.ravel()))
