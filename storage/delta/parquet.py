"""How rows lie in Parquet files: one file per table and iteration, in row groups of a few episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from t6gps.storage import durable, schema
from t6gps.storage.objects import place

_VERIFIED = ds.ParquetFileFormat(
    default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
)
"""Pages carry a CRC-32, which every reading checks; those of older files have none."""


@dataclass(frozen=True)
class Files:
    """Files of a table; with `iterations_n` those rows alone that earlier iterations have left, else all."""

    paths: list[str]
    iterations_n: int | None = None


def write(file: Path, definition: pa.Schema, groups: Iterable[pa.Table]) -> None:
    """Write `file` durably, whole or not at all, with one row group per table; each is let go when it is written.

    Noisy floats, also inside lists, are split by bytes and everything else uses dictionaries: a quarter
    smaller than the defaults.
    """
    floats = [field for field in definition if pa.types.is_floating(_leaf(field.type))]
    try:
        with pq.ParquetWriter(
            durable.hidden(file),
            definition,
            compression="zstd",
            compression_level=1,  # higher ones take a fifth longer for noisy floats, and save nothing
            write_page_checksum=True,
            use_dictionary=[field.name for field in definition if field not in floats],
            use_byte_stream_split=[
                f"{field.name}.list.element" if pa.types.is_list(field.type) else field.name for field in floats
            ],
        ) as writer:
            for group in groups:
                writer.write_table(group, row_group_size=max(group.num_rows, 1))
    except BaseException:
        durable.hidden(file).unlink(missing_ok=True)
        raise
    durable.publish(file)


def groups(file: Path, columns: list[str]) -> Iterator[pa.Table]:
    """Columns of a file's row groups, one after the other. ArrowException or OSError where the file is torn."""
    with pq.ParquetFile(place.source(file), page_checksum_verification=True) as found:
        for number in range(found.num_row_groups):
            yield found.read_row_group(number, columns)


def row_groups(table: str, paths: list[str], wanted: pc.Expression) -> Iterator[pa.Table]:
    """The wanted rows of files, a row group at a time; groups that cannot have any are not read. Typed as `rows`."""
    definition, (file_system, found) = schema.TABLES[table], place.located(paths)
    for fragment in ds.dataset(found, definition, format=_VERIFIED, filesystem=file_system).get_fragments():
        for group in fragment.split_by_row_group(wanted, definition):
            yield group.to_table(definition, filter=wanted)


def holds(file: Path, groups: Iterable[pa.Table]) -> bool:
    """True when the row groups of `file` are these tables."""
    with pq.ParquetFile(file, page_checksum_verification=True) as found:
        known = iter(range(found.num_row_groups))
        same = all((number := next(known, None)) is not None and found.read_row_group(number).equals(g) for g in groups)
        return same and next(known, None) is None


def rows(table: str, files: Files) -> ds.Dataset:
    """The rows of files, lazily, typed as in `schema.TABLES`."""
    definition = schema.TABLES[table]
    if not files.paths:
        return ds.dataset(definition.empty_table())
    file_system, paths = place.located(files.paths)
    found = ds.dataset(paths, definition, format=_VERIFIED, filesystem=file_system)
    return found if files.iterations_n is None else found.filter(_seen(definition, files.iterations_n))


def rows_of_runs(table: str, files: Mapping[str, Files]) -> ds.Dataset:
    """The rows of files of many runs, by the runs' names, lazily, with the column `run` before the others."""
    definition = pa.schema([schema.RUN, *schema.TABLES[table]])
    of_runs = [pc.field("run") == run for run, found in files.items() for _ in found.paths]
    if not of_runs:
        return ds.dataset(definition.empty_table())
    file_system, paths = place.located(path for found in files.values() for path in found.paths)
    rows = ds.FileSystemDataset.from_paths(
        paths,
        schema=definition,
        format=_VERIFIED,
        filesystem=file_system,
        partitions=of_runs,
    )
    for run, found in files.items():
        if found.iterations_n is not None:
            rows = rows.filter((pc.field("run") != run) | _seen(definition, found.iterations_n))
    return rows


def _seen(definition: pa.Schema, iterations_n: int) -> pc.Expression:
    seen = pc.field("iteration") < iterations_n
    return seen | pc.field("iteration").is_null() if definition.field("iteration").nullable else seen


def version(file: str) -> int:
    """The schema version of a file's rows, 0 where another program wrote it. OSError or ArrowException without one."""
    return version_of(schema_of(file))


def schema_of(file: str) -> pa.Schema:
    """The columns of a file, here or in an object store. OSError or ArrowException where it cannot be read."""
    file_system, (path,) = place.located([file])
    return pq.read_schema(path, filesystem=file_system)


def differs(table: str, there: pa.Schema) -> str | None:
    """How columns differ from those of the table, of which older files may lack some that may be null."""
    if version_of(there) > schema.SCHEMA_VERSION:
        return f"it is of version {version_of(there)}, and this t6gps reads up to {schema.SCHEMA_VERSION}"
    for column in schema.TABLES[table]:
        if column.name not in there.names:
            if not column.nullable:
                return f"column {column.name} is missing"
        elif there.field(column.name).type != column.type:
            return f"column {column.name} must be {column.type}, found {there.field(column.name).type}"
    unknown = set(there.names) - set(schema.TABLES[table].names)
    return f"column {min(unknown)} is unknown" if unknown else None


def version_of(there: pa.Schema) -> int:
    """The version of a file with this schema, 0 where another program wrote it."""
    return int((there.metadata or {}).get(b"t6gps_schema_version", b"0"))


def _leaf(kind: pa.DataType) -> pa.DataType:
    return kind.value_type if pa.types.is_list(kind) else kind
