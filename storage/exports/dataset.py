"""A dataset for other programs: episodes of runs in a foreign format, with card, statistics and provenance.

OUT/README.md           the card
OUT/statistics.json     of each column; LeRobot keeps its own at meta/stats.json
OUT/episodes.parquet    a row for each episode: its number, its run, and its row of `episodes`
OUT/provenance/RUN/     settings and origin of each run
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import pyarrow as pa

from t6gps.storage import durable, schema
from t6gps.storage.delta import parquet
from t6gps.storage.errors import ConfigError
from t6gps.storage.exports import card, lerobot, minari, rllib, selection
from t6gps.storage.exports import parquet as plain
from t6gps.storage.exports.card import Asked
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import NUMBER, Numbered, Source

FORMATS: Mapping[str, Format] = MappingProxyType(
    {"lerobot": lerobot.FORMAT, "minari": minari.FORMAT, "rllib": rllib.FORMAT, "parquet": plain.FORMAT}
)
EPISODES = pa.schema([NUMBER, schema.RUN, *schema.EPISODES], schema.EPISODES.metadata)
OF_RUN = ("config.json", "origin.json", "study.json")
"""Files of a run that say what made it."""


@dataclass(frozen=True)
class Exported:
    """What was written: its folder, and how many runs, episodes and control steps are in it; what is not."""

    path: Path
    runs: int
    episodes: int
    steps: int
    losses: tuple[str, ...]


def write(
    form: Format, out: Path, asked: Asked, sources: Sequence[Source], progress: Callable[[int, int], object]
) -> Exported:
    """Write episodes of runs as a dataset, whole or not at all; `progress` is told of each.

    ConfigError where `out` exists or cannot be written, DataError where a run is not whole.
    """
    out = out.expanduser().absolute()
    if os.path.lexists(out):
        raise _taken(out)
    try:
        with durable.draft(out) as draft:
            _fill(draft, out.name, form, asked, sources, progress)
            durable.sync_tree(draft)
            if not durable.claim(draft, out):
                raise _taken(out)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error}; name another folder, with room") from error
    summaries = [source.summaries for source in sources]
    steps_n = sum(sum(rows.column("steps").to_pylist()) for rows in summaries)
    return Exported(out, len(sources), sum(rows.num_rows for rows in summaries), steps_n, form.losses)


def _fill(
    folder: Path,
    name: str,
    form: Format,
    asked: Asked,
    sources: Sequence[Source],
    progress: Callable[[int, int], object],
) -> None:
    episodes_n = sum(source.summaries.num_rows for source in sources)

    def told() -> Iterator[Numbered]:
        for numbered in selection.episodes(sources):
            yield numbered
            progress(numbered.index + 1, episodes_n)

    totals = form.write(folder, name, told())
    statistics = folder / form.statistics
    if not statistics.exists():
        content = {column: found.to_json() for column, found in totals.items()}
        statistics.write_text(json.dumps(content, indent=1))
    parquet.write(folder / "episodes.parquet", EPISODES, _summaries(sources))
    for source in sources:
        place = folder / "provenance" / source.run.name
        place.mkdir(parents=True)
        for file in OF_RUN:
            if (source.run.path / file).exists():
                (place / file).write_bytes((source.run.path / file).read_bytes())
    (folder / "README.md").write_text(card.card(name, form, asked, sources, totals), encoding="utf-8")


def _summaries(sources: Sequence[Source]) -> Iterator[pa.Table]:
    first = 0
    for source in sources:
        rows_n = source.summaries.num_rows
        numbers = pa.array(range(first, first + rows_n), pa.int64())
        columns = [numbers, pa.repeat(source.run.name, rows_n), *source.summaries.columns]
        yield pa.Table.from_arrays(columns, schema=EPISODES)
        first += rows_n


def _taken(out: Path) -> ConfigError:
    return ConfigError(f"{out} exists already; name a new folder, or remove that one")
