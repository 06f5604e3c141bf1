"""Append, size, one episode and SQL of a run beside those of other stores, and how long many runs take."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa

from t6gps.service.bench.contenders import PRESET
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.stores import contestants, many_runs, material, samples
from t6gps.service.bench.stores.contestants import STORES, Store, T6Gps
from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.records import Episode
from t6gps.storage.sql import inprocess
from t6gps.storage.sql.query import Question, query

ROUNDS = 5
SQL = "SELECT iteration, avg(cost) AS cost, max(com_z_m) AS com_z_m FROM frames GROUP BY iteration ORDER BY iteration"
WAYS: Mapping[str, Callable[[Run, str], pa.Table]] = {
    "in_process": lambda run, sql: inprocess.ask(Question([run], sql)),
    "sandbox": lambda run, sql: query(Question([run], sql)),
}
"""Ways to ask a run, beside DuckDB in this process on the same files."""
READS_N = 20
"""Episodes that are read from each store."""
SMALL_SHARE = 10
"""An iteration of many runs is so many times smaller."""
NOTES = (
    f"episodes of preset {PRESET}, untrained policy, all columns of frames in each store, files in the page cache",
    "t6gps appends all tables of an iteration and forces them to disk; the others write frames, and force nothing",
    "lerobot_layout is LeRobot's way of writing, by pyarrow; minari is null where it is not installed",
)


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    rounds                     appends, and turns of each question
    episodes_n                 of an iteration; 300 have 75,300 rows
    growth_n                   iterations of a long run
    runs_n, run_iterations_n   many runs, and iterations of each
    """

    rounds: int = ROUNDS
    episodes_n: int = 300
    growth_n: int = 50
    runs_n: int = 500
    run_iterations_n: int = 10

    @classmethod
    def within(cls, rounds: int) -> Sizes:
        """Sizes for so many rounds: fewer than the default mean less data."""
        whole = cls()
        share = min(1.0, rounds / whole.rounds)
        episodes_n, growth_n, runs_n = (
            max(10, round(number * share)) for number in (whole.episodes_n, whole.growth_n, whole.runs_n)
        )
        return cls(rounds, episodes_n, growth_n, runs_n)


def storage(say: Say, rounds: int = ROUNDS) -> dict[str, float | None]:
    """Everything that `t6gps bench storage` reports, from so many rounds (`measure`). ConfigError for none."""
    if rounds < 1:
        raise ConfigError(f"bench storage needs rounds >= 1, found {rounds}")
    return measure(Sizes.within(rounds), say)


def measure(sizes: Sizes, say: Say) -> dict[str, float | None]:
    """The figures by name; STORE is one of contestants.STORES, null where it is not installed.

    append_rows_n, append_STORE_s      rows of an iteration, and seconds to keep it
    size_STORE                         bytes of frames over those of the numbers in memory, each in its own type
    episode_STORE_ms                   to read one episode with all columns
    sql_duckdb_ms, sql_WAY_ratio       a mean over frames by DuckDB in this process; what a way of WAYS takes over that
    windows_ratio                      `samples.windows_ratio`
    append_growth                      the last fifth of a long run's commits over its first fifth
    runs_s, runs_first_s, mean_over_runs_s     `many_runs.many_runs`
    """
    episodes = material.simulated(sizes.episodes_n, say)
    figures: dict[str, float | None] = {"append_rows_n": float(material.rows_n(episodes))}
    with tempfile.TemporaryDirectory() as folder:
        stores = {name: STORES[name](Path(folder) / name) for name in contestants.installed()}
        appended = _appended(stores, episodes, sizes.rounds, say)
        read = _read(stores, episodes, sizes.rounds, say)
        raw = sizes.rounds * material.raw_bytes(episodes)
        for name in STORES:
            store = stores.get(name)
            figures[f"append_{name}_s"] = appended.get(name)
            figures[f"size_{name}"] = None if store is None else _bytes(store.path) / raw
            figures[f"episode_{name}_ms"] = read.get(name)
        ours = stores["t6gps"]
        assert isinstance(ours, T6Gps)
        figures |= _asked(ours.run, sizes.rounds, say)
        figures["windows_ratio"] = samples.windows_ratio(ours.run, say)
    figures["append_growth"] = _growth(episodes, sizes.growth_n, say)
    few = episodes[: max(1, sizes.episodes_n // SMALL_SHARE)]
    return figures | many_runs.many_runs(few, sizes.runs_n, sizes.run_iterations_n, sizes.rounds, say)


def _appended(stores: Mapping[str, Store], episodes: Sequence[Episode], rounds: int, say: Say) -> dict[str, float]:
    """Seconds of an append, medians over rounds, in which the stores take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in stores}
    for number in range(rounds):
        iteration = material.of_iteration(episodes, number)
        for name in list(stores) if number % 2 == 0 else reversed(list(stores)):
            start = time.perf_counter()
            stores[name].append(number, iteration)
            seconds[name].append(time.perf_counter() - start)
            say(f"append {number + 1} of {rounds}: {name} {seconds[name][-1]:.2f} s")
    return {name: float(np.median(taken)) for name, taken in seconds.items()}


def _read(stores: Mapping[str, Store], episodes: Sequence[Episode], rounds: int, say: Say) -> dict[str, float]:
    """Milliseconds to read an episode, medians over some of all iterations. RunError for one with other costs."""
    seconds: dict[str, list[float]] = {name: [] for name in stores}
    for number in range(READS_N):
        place, iteration = number * 7 % len(episodes), number % rounds
        expected = episodes[place].frames.column("cost").to_numpy()
        for name, store in stores.items():
            start = time.perf_counter()
            costs = store.costs(iteration * len(episodes) + place)
            seconds[name].append(time.perf_counter() - start)
            if not np.array_equal(costs, expected):
                raise RunError(f"{name} gives other costs than were appended")
    taken = {name: 1e3 * float(np.median(of_store)) for name, of_store in seconds.items()}
    say(", ".join(f"{name} {milliseconds:.1f} ms" for name, milliseconds in taken.items()) + " for an episode")
    return taken


def _asked(run: Run, rounds: int, say: Say) -> dict[str, float | None]:
    """What a question takes in each way over DuckDB by itself, medians over rounds. RunError for another answer."""
    files, plain = tables.files(run, ["frames"])["frames"].paths, duckdb.connect()
    sql, seconds = SQL.replace("FROM frames", f"FROM read_parquet({files})"), list[list[float]]()
    for number in range(rounds + 1):
        start = time.perf_counter()
        expected = plain.sql(sql).to_arrow_table()
        taken = [time.perf_counter() - start]
        for name, way in WAYS.items():
            start = time.perf_counter()
            found = way(run, SQL)
            taken.append(time.perf_counter() - start)
            if not np.allclose(found.column("cost").to_numpy(), expected.column("cost").to_numpy()):
                raise RunError(f"{name} gives another answer than DuckDB by itself")
        if number:  # the first one warms up
            seconds.append(taken)
    medians = np.median(seconds, axis=0)
    ratios = {f"sql_{name}_ratio": float(median / medians[0]) for name, median in zip(WAYS, medians[1:], strict=True)}
    say(", ".join(f"{name} {ratio:.1f}" for name, ratio in ratios.items()))
    return {"sql_duckdb_ms": 1e3 * float(medians[0]), **ratios}


def _growth(episodes: Sequence[Episode], iterations_n: int, say: Say) -> float:
    """Median time of the last fifth of the commits of a long run over that of the first fifth."""
    seconds, fifth = list[float](), max(1, iterations_n // 5)
    with tempfile.TemporaryDirectory() as folder:
        store = T6Gps(Path(folder))
        for number in range(iterations_n):
            iteration = material.of_iteration(episodes, number)
            start = time.perf_counter()
            store.append(number, iteration)
            seconds.append(time.perf_counter() - start)
    growth = float(np.median(seconds[-fifth:]) / np.median(seconds[:fifth]))
    say(f"{iterations_n} commits: the last fifth take {growth:.2f} times as long as the first")
    return growth


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
