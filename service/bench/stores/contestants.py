"""Stores that keep the frames of the same episodes with all columns, side by side.

    t6gps            a run: all its tables, forced to disk, checksums of pages and a SHA-256 of each file
    parquet          a file for each iteration, as pyarrow writes it by default
    lerobot_layout   the same as LeRobot v3 writes its data: snappy, dictionaries, a row group for each episode
    duckdb           a table in one DuckDB file
    minari           Minari's HDF5, its default: every column is an observation, but for the actions

None but t6gps forces what it writes to disk, and none but t6gps would find a changed byte.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, final

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from numpy.typing import NDArray

from t6gps.service.bench.stores import material
from t6gps.storage import catalog, schema, tables
from t6gps.storage.delta import iterations
from t6gps.storage.fields import vector_length
from t6gps.storage.records import Episode

if TYPE_CHECKING:
    from gymnasium.spaces import Box


class Store(Protocol):
    """Keeps episodes; `path` has all that it has written of their frames."""

    path: Path

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        """Keep the episodes of an iteration."""

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        """Read an episode with all its columns; its costs [T + 1]."""


@final
class T6Gps:
    """A run below a root of its own."""

    def __init__(self, folder: Path) -> None:
        self.run = catalog.create(folder, "bench", "{}")
        self.path = self.run.tables / "frames"

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        iterations.commit(self.run, iteration, episodes, material.learned(iteration))

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        return _costs(tables.episode(self.run, episode_id).frames)


@final
class Parquet:
    """Files that pyarrow writes and finds by itself."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        folder.mkdir()

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        pq.write_table(_frames(episodes), self.path / f"{iteration:06d}.parquet")

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        return _costs(ds.dataset(self.path).to_table(filter=pc.field("episode_id") == episode_id))


@final
class LeRobotLayout:
    """Files as LeRobot's own writer makes them."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        folder.mkdir()

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        file = self.path / f"file-{iteration:03d}.parquet"
        with pq.ParquetWriter(file, schema.FRAMES, compression="snappy", use_dictionary=True) as writer:
            for episode in episodes:
                writer.write_table(episode.frames)

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        return _costs(ds.dataset(self.path).to_table(filter=pc.field("episode_id") == episode_id))


@final
class DuckDb:
    """A table in a file, which is closed after each use, as by a program that comes and goes."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        folder.mkdir()
        with self._opened() as connection:
            connection.register("empty", schema.FRAMES.empty_table())
            connection.execute("CREATE TABLE frames AS SELECT * FROM empty")

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        with self._opened() as connection:
            connection.register("appended", _frames(episodes))
            connection.execute("INSERT INTO frames SELECT * FROM appended")
            connection.execute("CHECKPOINT")

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        with self._opened() as connection:
            found = connection.sql("SELECT * FROM frames WHERE episode_id = $number", params={"number": episode_id})
            return _costs(found.to_arrow_table())

    def _opened(self) -> duckdb.DuckDBPyConnection:
        return duckdb.connect(str(self.path / "frames.duckdb"))


@final
class Minari:
    """A data set of Minari. Rewards and ends are those of its interface; they take a byte or eight a row."""

    def __init__(self, folder: Path) -> None:
        from gymnasium import spaces
        from minari.dataset.minari_storage import MinariStorage

        self.path = folder
        boxes = {field.name: _box(field) for field in schema.FRAMES}
        action = boxes.pop("action")
        self._storage = MinariStorage.new(folder, spaces.Dict(list(boxes.items())), action, data_format="hdf5")

    def append(self, iteration: int, episodes: Sequence[Episode]) -> None:
        self._storage.update_episodes([_buffer(episode) for episode in episodes])

    def costs(self, episode_id: int) -> NDArray[np.float64]:
        (episode,) = self._storage.get_episodes([episode_id])
        return np.asarray(episode["observations"]["cost"])[:, 0]


STORES: Mapping[str, Callable[[Path], Store]] = {
    "t6gps": T6Gps,
    "parquet": Parquet,
    "lerobot_layout": LeRobotLayout,
    "duckdb": DuckDb,
    "minari": Minari,
}


def installed() -> list[str]:
    """The stores that this machine has."""
    return [name for name in STORES if name != "minari" or importlib.util.find_spec("minari") is not None]


def _frames(episodes: Sequence[Episode]) -> pa.Table:
    return pa.concat_tables([episode.frames for episode in episodes])


def _costs(frames: pa.Table) -> NDArray[np.float64]:
    return np.asarray(frames.sort_by("step").column("cost").to_numpy())


def _shape(field: pa.Field) -> tuple[int]:
    return (vector_length(field) or 1,)


def _box(field: pa.Field) -> Box:
    from gymnasium import spaces

    kind = field.type.value_type if pa.types.is_list(field.type) else field.type
    if pa.types.is_integer(kind):
        return spaces.Box(-1, 2**31 - 1 if kind.bit_width > 8 else 127, _shape(field), kind.to_pandas_dtype())
    return spaces.Box(-np.inf, np.inf, _shape(field), kind.to_pandas_dtype())


def _array(rows: pa.Table, field: pa.Field) -> NDArray[np.generic]:
    """A column [rows, entries]. There are no nulls in arrays: they become -1 or NaN."""
    column = rows.column(field.name)
    if pa.types.is_integer(field.type):
        column = pc.fill_null(column, pa.scalar(-1, field.type))
    array = schema.array(pa.table([column], schema=pa.schema([field])), field.name)
    return array.reshape(-1, *_shape(field))


def _buffer(episode: Episode) -> object:
    from minari.data_collector import EpisodeBuffer

    rows, steps_n = episode.frames, episode.frames.num_rows - 1
    arrays = {field.name: _array(rows, field) for field in schema.FRAMES}
    actions, means = arrays.pop("action"), arrays["action_mean"]
    arrays["action_mean"] = np.concatenate([means, np.full_like(means[:1], np.nan)])
    return EpisodeBuffer(
        id=episode.episode_id,
        observations=arrays,
        actions=actions,
        rewards=list(-rows.column("cost").to_numpy()[1:]),
        terminations=[False] * steps_n,
        truncations=[False] * (steps_n - 1) + [True],
    )
