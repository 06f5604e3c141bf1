"""The episodes of one iteration as a stream: each is checked, copied and cut when it comes, and joined at the end.

Only the columns that the learner needs are copied. An episode's table may lie in memory that others want back; nothing
of it is kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import pyarrow as pa

from t6gps.learner.algorithm.segments import Pieces, cut, join
from t6gps.learner.rows import AnyArray, Columns, Ints, Rows
from t6gps.storage.errors import DataError

BLOCK_BYTES = 2**26
"""Memory for many episodes' entries of a column.

Blocks of more than 32 MB come from the operating system and go back to it, while smaller ones may leave holes in the
heap. Pages that nothing was written to cost nothing.
"""


class Joined(NamedTuple):
    """Episodes one under another: columns of all rows, and where their segments lie."""

    columns: Columns
    pieces: Pieces


class Reading(Protocol):
    """What is read of an episode."""

    def read(self, frames: pa.Table) -> Columns:
        """Columns of one episode, views where possible. DataError when it cannot be learned from."""


class RowReading(Reading, Protocol):
    """Reads rows; `acts` and `starts` are among its columns."""

    def rows(self, columns: Columns) -> Rows:
        """Rows of all episodes, from what `read` found in each."""


class Episodes:
    """Episodes of one iteration, in the order in which they come.

    readings   whose columns are kept; `acts` and `starts` must be among them
    """

    def __init__(self, readings: Iterable[Reading], longest_segment_steps: int) -> None:
        self._readings = tuple(readings)
        self._longest_segment_steps = longest_segment_steps
        self._columns: dict[str, _Blocks] = {}
        self._pieces: dict[int, Pieces] = {}

    def __contains__(self, episode_id: int) -> bool:
        return episode_id in self._pieces

    def add(self, episode_id: int, frames: pa.Table, constants: Mapping[str, float] | None = None) -> None:
        """Take an episode that is not among them. DataError when its record is inconsistent.

        constants   further columns, by the value that all rows of the episode have
        """
        columns: Columns = {}
        try:
            for reading in self._readings:
                columns |= reading.read(frames)
        except DataError as error:
            raise DataError(f"episode {episode_id}: {error}") from error
        for name, value in (constants or {}).items():
            columns[name] = np.full(frames.num_rows, value, dtype=np.float32)
        pieces = cut(columns["starts"], columns["acts"], self._longest_segment_steps)
        for name, values in columns.items():
            self._columns.setdefault(name, _Blocks()).append(values)
        self._pieces[episode_id] = pieces

    def clear(self) -> None:
        """Let go of all episodes."""
        self._columns.clear()
        self._pieces.clear()

    def joined(self) -> Joined:
        """All episodes in ascending order of their ids.

        No episode is left after it. DataError when there is no episode, or none has a control step.
        """
        if not self._pieces:
            raise DataError("the learner has no episodes; add at least one before it cuts segments")
        arrived = np.array(list(self._pieces))
        order = np.argsort(arrived)
        columns = {name: self._columns.pop(name).joined(order) for name in list(self._columns)}
        pieces = join([self._pieces[episode_id] for episode_id in arrived[order].tolist()])
        self._pieces.clear()
        if not columns["acts"].any():
            raise DataError(
                f"none of the {len(arrived)} episodes has a single control step; there is nothing to learn from"
            )
        return Joined(columns, pieces)


def together(iterations: Sequence[Joined]) -> Joined:
    """The episodes of at least one iteration, one iteration under another."""
    if len(iterations) == 1:
        return iterations[0]
    names = iterations[0].columns
    columns = {name: np.concatenate([each.columns[name] for each in iterations]) for name in names}
    return Joined(columns, join([each.pieces for each in iterations]))


class _Blocks:
    """A column of many episodes in blocks of memory."""

    def __init__(self) -> None:
        self._parts: list[AnyArray] = []
        self._free: AnyArray | None = None

    def append(self, values: AnyArray) -> None:
        """Copy an episode's entries [rows, ...]."""
        n = len(values)
        if self._free is None or len(self._free) < n:
            rows_n = max(n, BLOCK_BYTES // max(values[:1].nbytes, 1))
            self._free = np.empty((rows_n, *values.shape[1:]), dtype=values.dtype)
        part, self._free = self._free[:n], self._free[n:]
        part[:] = values
        self._parts.append(part)

    def joined(self, order: Ints) -> AnyArray:
        """The parts in this order as one array; each block is let go when its parts are copied."""
        lengths = np.array([len(part) for part in self._parts])
        first = np.empty_like(order)
        first[order] = np.cumsum(lengths[order]) - lengths[order]
        whole = np.empty((lengths.sum(), *self._parts[0].shape[1:]), dtype=self._parts[0].dtype)
        self._free = None
        while self._parts:
            part = self._parts.pop()
            start = first[len(self._parts)]
            whole[start : start + len(part)] = part
        return whole
