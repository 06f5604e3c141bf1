"""Row groups of frames, found by the episodes in them: one is read without the rest of its file.

Files never change once they are committed, so that what was learned of one holds until it is replaced.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import pyarrow as pa
import pyarrow.parquet as pq

from t6gps.storage import schema
from t6gps.storage.delta.parquet import Files

KNOWN_FILES_N = 4096


@dataclass(frozen=True)
class Group:
    """A row group of a file; the numbers of its episodes lie in first .. last."""

    path: str
    number: int
    first: int
    last: int


def groups(files: Files) -> list[Group]:
    """The row groups of files, in their order. ArrowException or OSError where one is torn."""
    found = list[Group]()
    for path in files.paths:
        status = os.stat(path)  # noqa: PTH116 # it is asked of every file, each time
        found.extend(_groups(path, status.st_size, status.st_mtime_ns))
    return found


def read(table: str, group: Group, columns: Sequence[str]) -> pa.Table:
    """Columns of a row group, typed as in `schema.TABLES`; null where its version did not know one.

    ArrowException or OSError where the file is torn, or a page differs from its checksum.
    """
    wanted = pa.schema([schema.TABLES[table].field(name) for name in columns])
    with pq.ParquetFile(group.path, page_checksum_verification=True) as file:
        there = frozenset(file.schema_arrow.names)
        known = [name for name in columns if name in there]
        rows = file.read_row_group(group.number, known, use_threads=False)
    return pa.table(
        [
            rows.column(field.name).cast(field.type) if field.name in there else pa.nulls(rows.num_rows, field.type)
            for field in wanted
        ],
        schema=wanted,
    )


@lru_cache(KNOWN_FILES_N)
def _groups(path: str, size_n: int, changed_ns: int) -> tuple[Group, ...]:
    with pq.ParquetFile(path) as file:
        place = file.schema_arrow.names.index("episode_id")
        return tuple(Group(path, number, *_ends(file, number, place)) for number in range(file.metadata.num_row_groups))


def _ends(file: pq.ParquetFile, number: int, place: int) -> tuple[int, int]:
    """The least and greatest episode of a row group: a file that another program wrote may not say them."""
    statistics = file.metadata.row_group(number).column(place).statistics
    if statistics is not None and statistics.has_min_max:
        return int(statistics.min), int(statistics.max)
    numbers = file.read_row_group(number, ["episode_id"]).column(0).to_numpy()
    return int(numbers.min(initial=0)), int(numbers.max(initial=-1))
