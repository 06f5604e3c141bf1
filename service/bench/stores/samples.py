"""Samples of a run as training takes them: windows in any order, beside a call for the episode of each."""

from __future__ import annotations

import time

import numpy as np

from t6gps.service.bench.rounds import Say
from t6gps.service.stores.opening import open_store
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

COLUMNS, LENGTH_N = ("observation", "action"), 16
CALLS_N, WINDOWS_N = 20, 2000
SEED = 0


def windows_ratio(run: Run, say: Say) -> float:
    """How many times as long a sample takes by a call of `episode` as by a window. RunError for different rows."""
    store = open_store(run.path.parent)
    stored, windows = store.run(run.name), store.windows(COLUMNS, length=LENGTH_N, runs=run.name)
    chosen = np.random.default_rng(SEED).integers(len(windows), size=WINDOWS_N).tolist()
    start = time.perf_counter()
    for index in chosen:
        window = windows[index]
    window_s = (time.perf_counter() - start) / WINDOWS_N
    episodes_n = stored.sql("SELECT count(*) AS n FROM episodes").arrow().column("n")[0].as_py()
    per_episode = len(windows) // episodes_n  # all have the same length here
    start = time.perf_counter()
    for index in chosen[-CALLS_N:]:
        number, first = divmod(index, per_episode)
        rows = stored.episode(number, COLUMNS)
        sample = {name: rows[name][first : first + LENGTH_N] for name in COLUMNS}
    call_s = (time.perf_counter() - start) / CALLS_N
    if not all(np.array_equal(window[name], sample[name]) for name in COLUMNS):
        raise RunError("a window has other rows than its episode")
    say(f"a window takes {1e3 * window_s:.2f} ms, a call of episode {1e3 * call_s:.2f} ms")
    return call_s / window_s
