"""Row groups of frames, found by the episodes in them: one is read without the rest of its file.

Files never change once they are committed, so that what was learned of one holds until it is replaced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import pyarrow as pa
import pyarrow.parquet as pq

from t6gps.storage import schema
from t6gps.storage.delta.parquet import Files
from t6gps.storage.objects import place

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
        file_system, (inner,) = place.located([path])
        status = file_system.get_file_info(inner)
        found.extend(_groups(path, status.size, status.mtime_ns))
    return found


def read(table: str, group: Group, columns: Sequence[str]) -> pa.Table:
    """Columns of a row group, typed as in `schema.TABLES`; null where its version did not know one.

    ArrowException or OSError where the file is torn, or a page differs from its checksum.
    """
    wanted = pa.schema([schema.TABLES[table].field(name) for name in columns])
    file_system, (inner,) = place.located([group.path])
    with pq.ParquetFile(inner, filesystem=file_system, page_checksum_verification=True) as file:
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
def _groups(path: str, size_n: int | None, changed_ns: int | None) -> tuple[Group, ...]:
    file_system, (inner,) = place.located([path])
    with pq.ParquetFile(inner, filesystem=file_system) as file:
        column = file.schema_arrow.names.index("episode_id")
        return tuple(
            Group(path, number, *_ends(file, number, column)) for number in range(file.metadata.num_row_groups)
        )


def _ends(file: pq.ParquetFile, number: int, column: int) -> tuple[int, int]:
    """The least and greatest episode of a row group: a file that another program wrote may not say them."""
    statistics = file.metadata.row_group(number).column(column).statistics
    if statistics is not None and statistics.has_min_max:
        return int(statistics.min), int(statistics.max)
    numbers = file.read_row_group(number, ["episode_id"]).column(0).to_numpy()
    return int(numbers.min(initial=0)), int(numbers.max(initial=-1))
