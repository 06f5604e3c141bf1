"""Columns of tables as NumPy arrays in the shapes that the schema gives them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from t6gps.storage import fields, schema

SHAPES: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        **{
            field.name: (length,)
            for definition in schema.TABLES.values()
            for field in definition
            if (length := fields.vector_length(field)) is not None
        },
        "nodes": (12, 3),
        "node_velocities": (12, 3),
        "bar_positions": (6, 3),
        "bar_orientations": (6, 4),
        "bar_velocities": (6, 3),
        "bar_angular_velocities": (6, 3),
    }
)
"""What a row of a vector column holds: nodes, bars and cables come before axes."""


def arrays(table: pa.Table) -> dict[str, NDArray[np.generic]]:
    """Each column of a table by its name, as `array`."""
    return {name: array(name, table.column(name)) for name in table.column_names}


def array(name: str, column: pa.ChunkedArray) -> NDArray[np.generic]:
    """A column as an array [rows], or [rows, *shape] where its rows hold equally many numbers.

    The shape is that of SHAPES for a vector column of its name, else [numbers]. What is null is NaN, which makes
    integers and flags float64; text, and lists of several lengths, become objects.
    """
    whole = column.combine_chunks()
    kind = whole.type
    if pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return _vectors(name, whole)
    if pa.types.is_boolean(kind) and whole.null_count:
        whole = whole.cast(pa.int8())
    if whole.null_count and pa.types.is_integer(whole.type):
        whole = whole.cast(pa.float64())
    found: NDArray[np.generic] = whole.to_numpy(zero_copy_only=False)
    return found


def _vectors(name: str, column: pa.Array) -> NDArray[np.generic]:
    shape = SHAPES.get(name, ())
    lengths = pc.unique(pc.list_value_length(column).drop_null()).to_pylist() or [int(np.prod(shape))]
    leaf = column.type.value_type
    if len(lengths) != 1 or not (pa.types.is_floating(leaf) or pa.types.is_integer(leaf)):
        found = np.empty(len(column), object)
        found[:] = column.to_pylist()
        return found
    flat = array("", pa.chunked_array([column.drop_null().flatten()])).reshape(-1, lengths[0])
    if column.null_count:
        filled = np.full((len(column), lengths[0]), np.nan, np.result_type(flat.dtype, np.float32))
        filled[column.is_valid().to_numpy(zero_copy_only=False)] = flat
        flat = filled
    return flat.reshape(-1, *shape) if shape and np.prod(shape) == lengths[0] else flat
