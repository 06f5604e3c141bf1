"""Least, greatest, mean and standard deviation of columns, one episode after the other; nulls do not count."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import fields

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """Of each of the k entries of a column: how many numbers, their range, mean and summed squares about it."""

    count: Floats
    least: Floats
    most: Floats
    mean: Floats
    squares: Floats

    def to_json(self) -> dict[str, list[float] | list[int]]:
        """Lists of k numbers, without those entries that are always null; `count` is the most that one has."""
        known = self.count > 0
        numbers = {
            "min": self.least[known],
            "max": self.most[known],
            "mean": self.mean[known],
            "std": np.sqrt(self.squares[known] / self.count[known]),
        }
        return {name: array.tolist() for name, array in numbers.items()} | {"count": [int(self.count.max())]}


Totals = dict[str, Moments]


def moments(numbers: NDArray[np.generic]) -> Moments:
    """Those of rows [n] or [n, k]; NaN stands for null."""
    rows = numbers.astype(np.float64).reshape(len(numbers), -1)
    known = ~np.isnan(rows)
    count = known.sum(axis=0).astype(np.float64)
    mean = np.where(known, rows, 0.0).sum(axis=0) / np.maximum(count, 1.0)
    return Moments(
        count,
        np.where(known, rows, np.inf).min(axis=0, initial=np.inf),
        np.where(known, rows, -np.inf).max(axis=0, initial=-np.inf),
        mean,
        (np.where(known, rows - mean, 0.0) ** 2).sum(axis=0),
    )


def add(totals: Totals, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Let the columns of an episode count (Chan, Golub and LeVeque 1983)."""
    for name, numbers in columns.items():
        new, old = moments(numbers), totals.get(name)
        totals[name] = new if old is None else _merged(old, new)


def _merged(a: Moments, b: Moments) -> Moments:
    count = a.count + b.count
    share = b.count / np.maximum(count, 1.0)
    apart = b.mean - a.mean
    return Moments(
        count,
        np.minimum(a.least, b.least),
        np.maximum(a.most, b.most),
        a.mean + apart * share,
        a.squares + b.squares + apart**2 * a.count * share,
    )


def arrays(table: pa.Table) -> dict[str, NDArray[np.generic]]:
    """The columns of a table that hold numbers or flags, as [rows] or [rows, length]; NaN for null."""
    return {
        field.name: _array(table.column(field.name).combine_chunks(), fields.vector_length(field))
        for field in table.schema
        if not pa.types.is_string(field.type)
    }


def _array(column: pa.Array, length: int | None) -> NDArray[np.generic]:
    if length is None:
        numbers: NDArray[np.generic] = column.to_numpy(zero_copy_only=False)
        return numbers.astype(np.float64) if column.null_count else numbers
    held = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, length)
    if not column.null_count:
        return held
    rows = np.full((len(column), length), np.nan)
    rows[column.is_valid().to_numpy(zero_copy_only=False)] = held
    return rows
