"""Pieces of episodes for training: a sequence of windows, each some columns of so many control steps in a row.

A map-style dataset, such as torch's DataLoader takes, without torch: it has a length, gives the items of a batch at
once, and travels to another process, where it opens its files again. One SQL finds the windows; after that only row
groups are read, each once, as long as the cache has room for it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log, row_groups
from t6gps.storage.delta.row_groups import Group
from t6gps.storage.errors import ConfigError
from t6gps.storage.store import arrays
from t6gps.storage.store.result import Result

CACHE_BYTES_N = 2**30
"""Decoded columns that a process keeps by default."""
Item: TypeAlias = dict[str, NDArray[np.generic]]
_ACTIONS = frozenset({"action", "action_mean"})
_ALL = "SELECT run, episode_id, 0 AS first, steps + 1 - $left_out AS rows_n FROM episodes"
_CHOSEN = """
SELECT run, episode_id, min(step) AS first, count(*) AS rows_n FROM (
    SELECT run, episode_id, step, step - row_number() OVER (PARTITION BY run, episode_id ORDER BY step) AS span
    FROM frames JOIN episodes USING (run, iteration, episode_id)
    WHERE step <= steps - $left_out AND ({where}
    ))
GROUP BY run, episode_id, span
"""


@dataclass(frozen=True)
class _Spans:
    """Rows in which windows lie, one span after the other.

    group, episode, first   row group, episode and first control step of each span
    ends                    windows in the spans up to each, this one included
    """

    group: NDArray[np.int64]
    episode: NDArray[np.int64]
    first: NDArray[np.int64]
    ends: NDArray[np.int64]


@dataclass(frozen=True)
class _Block:
    """Columns of a row group, and the row at which each of its episodes begins."""

    columns: Item
    starts: Mapping[int, int]

    @property
    def nbytes(self) -> int:
        return sum(column.nbytes for column in self.columns.values())


@final
class _Cache:
    """Blocks that were used last, as many as there is room for. It travels empty."""

    def __init__(self, bytes_n: int) -> None:
        self._bytes_n, self._held_n = bytes_n, 0
        self._blocks: OrderedDict[int, _Block] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[_Cache], tuple[int]]:
        return _Cache, (self._bytes_n,)

    def get(self, number: int, load: Callable[[], _Block]) -> _Block:
        """A block, loaded where it is not held."""
        with self._lock:
            if number in self._blocks:
                self._blocks.move_to_end(number)
                return self._blocks[number]
            block = load()
            while self._blocks and self._held_n + block.nbytes > self._bytes_n:
                self._held_n -= self._blocks.popitem(last=False)[1].nbytes
            self._blocks[number] = block
            self._held_n += block.nbytes
            return block


@final
@dataclass(frozen=True, eq=False)
class Windows(Sequence[Item]):
    """Windows of `length` rows: dictionaries of arrays [length, *shape of the column], which belong to the caller.

    Integers that may be null are float64, with NaN for null. DataError where a file is damaged.
    """

    columns: tuple[str, ...]
    length: int
    _runs: tuple[Run, ...]
    _groups: tuple[tuple[int, Group], ...]
    _spans: _Spans
    _cache: _Cache

    def __len__(self) -> int:
        return int(self._spans.ends[-1]) if len(self._spans.ends) else 0

    def __getitem__(self, index: int) -> Item:  # type: ignore[override] # a slice would be another Windows
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Item]:
        """The windows of a batch; each row group is looked up once."""
        whole = np.asarray(indices, np.int64)
        whole = np.where(whole < 0, whole + len(self), whole)
        if ((whole < 0) | (whole >= len(self))).any():
            raise IndexError(f"there are {len(self)} windows, found {list(indices)}")
        spans = np.searchsorted(self._spans.ends, whole, side="right")
        behind = self._spans.ends[spans] - whole  # windows from there to the span's end
        lengths = np.diff(self._spans.ends, prepend=0)[spans] if len(spans) else behind
        steps = self._spans.first[spans] + lengths - behind
        found: list[Item] = [{}] * len(whole)
        for place in np.argsort(self._spans.group[spans], kind="stable"):
            block = self._block(int(self._spans.group[spans[place]]))
            row = block.starts[int(self._spans.episode[spans[place]])] + int(steps[place])
            found[place] = {name: column[row : row + self.length].copy() for name, column in block.columns.items()}
        return found

    def __iter__(self) -> Iterator[Item]:
        return (self[index] for index in range(len(self)))

    def _block(self, number: int) -> _Block:
        run, group = self._groups[number]
        return self._cache.get(number, lambda: _loaded(self._runs[run], group, self.columns))


def windows(
    ask: Callable[[str, Mapping[str, int]], Result],
    find: Callable[[str], Run],
    columns: Sequence[str],
    length: int,
    where: str | None = None,
    cache_bytes: int = CACHE_BYTES_N,
) -> Windows:
    """The windows of `length` rows in which each row meets a condition.

    ask       puts SQL with values of its $names to the tables `frames` and `episodes` of all runs that are meant
    find      a run by its name
    columns   of the table `frames`. With `action` or `action_mean` no window has the last state, which has none
    where     SQL over the columns of both tables, such as "kind = 0 AND episodes.cost < 0.1"; None takes all

    ConfigError for a length, DataError for a column, QueryError for a condition that cannot be.
    """
    if not isinstance(length, int) or length < 1:
        raise ConfigError(f"windows take a whole length >= 1, found {length!r}; give another number of control steps")
    names = tuple(dict.fromkeys(tables.columns_of("frames", columns).names))
    sql = _ALL if where is None else _CHOSEN.replace("{where}", where)
    sql = f"SELECT * FROM ({sql}) WHERE rows_n >= {length} ORDER BY run, episode_id, first"
    found = ask(sql, {"left_out": int(not _ACTIONS.isdisjoint(names))}).arrow()
    runs = tuple(find(name) for name in found.column("run").unique().to_pylist())
    groups, places = list[tuple[int, Group]](), list[NDArray[np.int64]]()
    for number, run in enumerate(runs):
        episodes = found.filter(pc.field("run") == run.name).column("episode_id").to_numpy()
        of_run = _groups(run)
        places.append(len(groups) + _places(run, of_run, episodes))
        groups += [(number, group) for group in of_run]
    spans = _Spans(
        group=np.concatenate([*places, np.empty(0, np.int64)]),
        episode=found.column("episode_id").to_numpy(),
        first=found.column("first").to_numpy().astype(np.int64),
        ends=np.cumsum(found.column("rows_n").to_numpy().astype(np.int64) - length + 1),
    )
    return Windows(names, length, runs, tuple(groups), spans, _Cache(cache_bytes))


def _groups(run: Run) -> list[Group]:
    with log.readable(run, "frames"):
        return sorted(row_groups.groups(tables.files(run, ["frames"])["frames"]), key=lambda group: group.first)


def _places(run: Run, groups: Sequence[Group], episodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which of the row groups of a run has each episode."""
    found = np.searchsorted([group.first for group in groups], episodes, side="right").astype(np.int64) - 1
    lasts = np.array([group.last for group in groups], np.int64)
    if len(episodes) and ((found < 0).any() or (lasts[found] < episodes).any()):
        raise log.damaged(run, "frames", "its row groups lack episodes, or overlap")
    return found


def _loaded(run: Run, group: Group, names: Sequence[str]) -> _Block:
    """A row group. DataError where the file is damaged, or its rows are not those of whole episodes in their order."""
    with log.readable(run, "frames"):
        rows = row_groups.read("frames", group, list(dict.fromkeys([*names, "episode_id", "step"])))
    episodes, starts = np.unique(rows.column("episode_id").to_numpy(), return_index=True)
    lengths = np.diff(np.sort(starts), append=rows.num_rows)
    if not np.array_equal(rows.column("step").to_numpy(), np.concatenate([np.arange(length) for length in lengths])):
        raise log.damaged(run, "frames", f"row group {group.number} of {group.path} has no whole episodes in order")
    columns = {name: arrays.array(name, _numbers(rows, name)) for name in names}
    return _Block(columns, dict(zip(episodes.tolist(), starts.tolist(), strict=True)))


def _numbers(rows: pa.Table, name: str) -> pa.ChunkedArray:
    """A column whose type does not hang on whether a null is among these rows."""
    column, field = rows.column(name), rows.schema.field(name)
    return column.cast(pa.float64()) if field.nullable and pa.types.is_integer(field.type) else column
