"""How long it takes to list many runs, and to ask all of them one thing."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from t6gps.service import config as configuration
from t6gps.service.bench.contenders import PRESET
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.stores import material
from t6gps.service.training import origin, summary
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode
from t6gps.storage.sql.query import Question, query

MEAN = "SELECT run, avg(cost) AS cost FROM episodes GROUP BY run ORDER BY run"
ROWS_N = 11
"""Of each episode: small ones suffice, since no frames are read."""
DEADLINE_S = 60.0


def many_runs(episodes: Sequence[Episode], runs_n: int, iterations_n: int, rounds: int, say: Say) -> dict[str, float]:
    """Seconds for so many runs, medians over rounds.

    runs_s, runs_first_s        to list them, as `t6gps runs` does; and the first time, when the cache is made
    mean_over_runs_s            for the mean cost of each run, by one query
    """
    with tempfile.TemporaryDirectory() as folder:
        runs = _made(Path(folder), material.short(episodes, ROWS_N), runs_n, iterations_n)
        say(f"{runs_n} runs of {iterations_n} iterations are made")

        def listed() -> None:
            if {summary.summary(run).done for run in catalog.list_runs(Path(folder))} != {iterations_n}:
                raise RunError("a run of the benchmark is not whole; see t6gps verify")

        first_s = _seconds(listed)
        _settle(runs, listed)
        expected = float(np.mean(tables.read(runs[0], "episodes", ["cost"]).column("cost").to_numpy()))

        def asked() -> None:
            means = query(Question(runs, MEAN)).column("cost").to_numpy()
            if len(means) != runs_n or not np.allclose(means, expected):
                raise RunError("the mean over runs is not that of their rows")

        taken = [(_seconds(listed), _seconds(asked)) for _ in range(rounds)]
    listed_s, asked_s = (float(np.median(seconds)) for seconds in zip(*taken, strict=True))
    say(f"{listed_s:.2f} s to list them, {asked_s:.2f} s for a mean over them")
    return {"runs_s": listed_s, "runs_first_s": first_s, "mean_over_runs_s": asked_s}


def _made(root: Path, episodes: Sequence[Episode], runs_n: int, iterations_n: int) -> list[Run]:
    """Runs with the same rows."""
    config = configuration.load(PRESET, [f"run.iterations={iterations_n}"])
    first = origin.create(config, root, "run-0")
    for iteration in range(iterations_n):
        iterations.commit(first, iteration, material.of_iteration(episodes, iteration), material.learned(iteration))
    for number in range(1, runs_n):
        shutil.copytree(first.path, root / f"run-{number}")
    return catalog.list_runs(root)


def _settle(runs: Sequence[Run], listed: Callable[[], None]) -> None:
    """List them until the cache has all: those that were made just now may not be kept at once."""
    deadline = time.monotonic() + DEADLINE_S
    while not all(any(run.cache.glob("[!.]*")) for run in runs):
        if time.monotonic() > deadline:
            raise RunError("the cache does not take the benchmark's runs; TMPDIR must be a writable folder")
        time.sleep(0.1)
        listed()


def _seconds(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
