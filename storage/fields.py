"""Columns of Arrow tables: how they are defined, with unit and meaning, and the check at every boundary."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa

from t6gps.storage.errors import DataError


def scalar(name: str, kind: pa.DataType, unit: str, text: str, nullable: bool = False) -> pa.Field:
    """A column of one value a row; unit "1" is a number without one, "" is text."""
    return pa.field(name, kind, nullable, {"unit": unit, "description": text})


def vector(name: str, length: int, unit: str, text: str, nullable: bool = False) -> pa.Field:
    """A column of `length` numbers a row."""
    metadata = {"unit": unit, "description": text, "length": str(length)}
    return pa.field(name, pa.list_(pa.float32()), nullable, metadata)


def numbers(name: str, kind: pa.DataType, unit: str, text: str) -> pa.Field:
    """A column of numbers whose count depends on the run's settings."""
    return pa.field(name, pa.list_(kind), False, {"unit": unit, "description": text})


def vector_length(field: pa.Field) -> int | None:
    """Entries of a vector column, None for one of another kind."""
    length = (field.metadata or {}).get(b"length")
    return None if length is None else int(length)


def check(table: pa.Table, schema: pa.Schema, where: str) -> pa.Table:
    """Return `table` when it follows `schema` to the letter.

    `nullable=False` is not enforced by Arrow itself, so nulls, vector lengths and non-finite numbers are checked
    here. Raises DataError naming `where` and the first column that is missing, unknown, of another type or length,
    null without permission, or not finite.
    """
    if not table.schema.equals(schema):
        if table.schema.names != schema.names:
            raise DataError(f"{where}: columns must be {schema.names}, found {table.schema.names}")
        for field, found in zip(schema, table.schema, strict=True):
            if found.type != field.type:
                raise DataError(f"{where}: column {field.name} must be {field.type}, found {found.type}")
    rules = _rules(schema)
    for batch in table.to_batches():
        for (name, nullable, length, finite), column in zip(rules, batch.columns, strict=True):
            if column.null_count and not nullable:
                raise DataError(f"{where}: column {name} must not be null, found {column.null_count} nulls")
            if not finite and not np.isfinite(_numbers(column, length, where, name).to_numpy()).all():
                raise DataError(f"{where}: column {name} holds numbers that are not finite")
    return table


def _numbers(column: pa.Array, length: int | None, where: str, name: str) -> pa.Array:
    """What the entries that are not null hold, one after the other."""
    entries = column.drop_null() if column.null_count else column
    if not pa.types.is_list(entries.type):
        return entries
    offsets = entries.offsets.to_numpy()
    if length is not None and (offsets[1:] - offsets[:-1] != length).any():
        raise DataError(f"{where}: every entry of column {name} must hold {length} numbers")
    held = entries.values.slice(offsets[0], offsets[-1] - offsets[0])
    if held.null_count:
        raise DataError(f"{where}: column {name} holds nulls inside its vectors")
    return held


@cache
def _rules(schema: pa.Schema) -> list[tuple[str, bool, int | None, bool]]:
    """Of each column: its name, whether it may be null, its length if it holds vectors, whether all it holds is finite.

    Read from a schema once, since every episode is checked.
    """
    return [(field.name, field.nullable, vector_length(field), _finite(field.type)) for field in schema]


def _finite(kind: pa.DataType) -> bool:
    """True for a type without infinity, and without nulls that its own null count does not count."""
    return not (pa.types.is_list(kind) or pa.types.is_floating(kind))
