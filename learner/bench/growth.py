"""How seconds and memory of the learner grow with the data: recorded episodes, replicated under new ids.

Each size is measured in a process of its own, whose memory nothing else has touched.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow as pa

from t6gps.learner.improvers.action_value import REMEMBERED_N
from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.storage import ipc

FACTORS = (1, 4, 16)
"""Sizes, in units of the recorded episodes."""


def measure(
    new_learner: Callable[[], Learner], episodes: Sequence[pa.Table], factors: Sequence[int] = FACTORS
) -> dict[str, float]:
    """Seconds and peak memory of an iteration over `episodes` as often as each factor says.

    learner_4x_steps         control steps of an iteration of four times the episodes
    learner_4x_seconds       the last of as many iterations as the action value remembers, from the first episode added
                             to the last phase
    learner_4x_processor_s   processor time of that iteration on all threads, which other processes disturb less
    learner_4x_peak_mb       largest resident memory of the process in all of them, the libraries and the recorded
                             episodes, which it reads where they lie, included

    `new_learner` is called in other processes and must be one that can be pickled.
    """
    figures: dict[str, float] = {}
    fresh = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episodes.arrow"
        path.write_bytes(ipc.pack(pa.concat_tables(episodes)))
        lengths = [table.num_rows for table in episodes]
        for factor in factors:
            with ProcessPoolExecutor(1, mp_context=fresh) as process:
                measured = process.submit(_iterate, new_learner, path, lengths, factor).result()
            figures[f"learner_{factor}x_steps"] = factor * (sum(lengths) - len(lengths))
            figures |= {f"learner_{factor}x_{name}": figure for name, figure in measured.items()}
    return figures


def _iterate(new_learner: Callable[[], Learner], path: Path, lengths: Sequence[int], factor: int) -> dict[str, float]:
    """Seconds and processor time of the last iteration, and peak memory."""
    (recorded,) = ipc.unpack(pa.memory_map(str(path)), 1)
    learner = new_learner()
    for _ in range(REMEMBERED_N):
        start, start_of_work = time.perf_counter(), time.process_time()
        for frames in _replicated(recorded, lengths, factor):
            learner.add(frames)
        for phase in PHASES:
            for _ in getattr(learner, phase.name)():
                pass
        spent = {"seconds": time.perf_counter() - start, "processor_s": time.process_time() - start_of_work}
    return spent | {"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def _replicated(recorded: pa.Table, lengths: Sequence[int], factor: int) -> Iterator[pa.Table]:
    """Each episode `factor` times, all under ids of their own."""
    place = recorded.schema.get_field_index("episode_id")
    firsts = np.cumsum(lengths) - lengths
    for copy in range(factor):
        for number, (first, length) in enumerate(zip(firsts.tolist(), lengths, strict=True)):
            ids = pa.array(np.full(length, copy * len(lengths) + number), type=pa.int64())
            yield recorded.slice(first, length).set_column(place, recorded.schema.field(place), ids)
