"""Which episodes leave, and their frames, one episode after the other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from t6gps.storage import fields, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, parquet
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode

NUMBER = fields.scalar("episode_index", pa.int64(), "1", "number of the episode, counted from 0 over all runs")


@dataclass(frozen=True)
class Source:
    """A run whose episodes leave.

    summaries   rows of `episodes` of those that do, in the order of their commit
    facts       what the card says of the run, by headings
    settings    its settings by name
    """

    run: Run
    summaries: pa.Table
    facts: Mapping[str, object]
    settings: Mapping[str, object]


@dataclass(frozen=True)
class Numbered:
    """An episode with its number among all that leave, and its run."""

    index: int
    run: str
    episode: Episode

    @property
    def steps(self) -> int:
        """Control steps T."""
        return int(self.episode.frames.num_rows) - 1

    @property
    def row(self) -> dict[str, object]:
        """Its row of `episodes`, and the run before."""
        return {"run": self.run, **self.episode.summary.to_pylist()[0]}


def source(run: Run, numbers: Sequence[int], facts: Mapping[str, object], settings: Mapping[str, object]) -> Source:
    """The episodes of a run that have these numbers."""
    chosen = pc.field("episode_id").isin(pa.array(numbers, pa.int64()))
    return Source(run, tables.read(run, "episodes", filter=chosen), facts, settings)


def episodes(sources: Sequence[Source]) -> Iterator[Numbered]:
    """The episodes of all runs, numbered from 0 in this order. No more than a few row groups are held.

    DataError for a run whose frames are not those of its episodes, or of an earlier version with other observations.
    """
    index = 0
    for source in sources:
        rows = _Rows(source)
        for place in range(source.summaries.num_rows):
            summary = source.summaries.slice(place, 1)
            yield Numbered(index, source.run.name, Episode(rows.frames(summary.to_pylist()[0]), summary))
            index += 1


class _Rows:
    """The frames of a run's episodes, read once and in order."""

    def __init__(self, source: Source) -> None:
        self._run = source.run
        chosen = pc.field("episode_id").isin(source.summaries.column("episode_id").combine_chunks())
        found = tables.files(source.run, ["frames"])["frames"]
        self._paths = found.paths
        self._groups = parquet.row_groups("frames", found.paths, chosen)
        self._held = schema.FRAMES.empty_table()

    def frames(self, summary: Mapping[str, int]) -> pa.Table:
        """The next T + 1 frames, which must be those of an episode."""
        number, rows_n = summary["episode_id"], summary["steps"] + 1
        where = f"run {self._run.name}, episode {number}"
        with log.readable(self._run, "frames"):
            while self._held.num_rows < rows_n and (group := next(self._groups, None)) is not None:
                self._held = pa.concat_tables([self._held, group.cast(schema.FRAMES)])
        found, self._held = self._held.slice(0, rows_n).combine_chunks(), self._held.slice(rows_n)
        steps, of = (found.column(name).to_numpy() for name in ("step", "episode_id"))
        if not np.array_equal(steps, np.arange(rows_n)) or (of != number).any():
            raise log.damaged(self._run, "frames", f"{where}: its {rows_n} frames are not there, one for each step")
        try:
            return fields.check(found, schema.FRAMES, where)
        except DataError as error:
            version = parquet.version(self._paths[0])
            raise DataError(
                f"{error}; it is of version {version} of the tables, this version, {schema.SCHEMA_VERSION}, has other "
                "columns; leave its run out with --run or --where"
            ) from None
