"""The rows that a SELECT gives, read when they are asked for, in the form that they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, TypeAlias, final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.errors import ConfigError
from t6gps.storage.store import arrays

if TYPE_CHECKING:
    import pandas
    import polars

Opened: TypeAlias = Callable[[], AbstractContextManager[pa.RecordBatchReader]]
"""Puts the question; its batches can be read until the context ends."""


@final
class Result:
    """What one SELECT gives. The question is put when its rows are first asked for; then they are kept.

    Each form raises QueryError for SQL that is refused or wrong, DataError where a table that it reads is damaged.
    Iterating gives batches as they come, without keeping them.
    """

    def __init__(self, opened: Opened) -> None:
        self._opened = opened
        self._table: pa.Table | None = None

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        with self._opened() as batches:
            yield from batches

    def arrow(self) -> pa.Table:
        """As a table of Arrow."""
        if self._table is None:
            with self._opened() as batches:
                self._table = batches.read_all()
        return self._table

    def pandas(self) -> pandas.DataFrame:
        """As a frame of pandas. ConfigError where it is not installed."""
        try:
            import pandas  # noqa: F401
        except ModuleNotFoundError:
            raise _missing("pandas") from None
        return self.arrow().to_pandas()

    def polars(self) -> polars.DataFrame:
        """As a frame of polars. ConfigError where it is not installed."""
        try:
            import polars
        except ModuleNotFoundError:
            raise _missing("polars") from None
        frame = polars.from_arrow(self.arrow())
        assert isinstance(frame, polars.DataFrame), "a table gives a frame"
        return frame

    def numpy(self) -> dict[str, NDArray[np.generic]]:
        """As arrays by column, [rows] or [rows, shape of the column] (`arrays.array`)."""
        return arrays.arrays(self.arrow())


def _missing(library: str) -> ConfigError:
    return ConfigError(f"a result as a frame of {library} needs {library}; install it with: pip install {library}")
