"""How seconds and memory of a whole iteration grow with its data, at 1, 4 and 16 times the paper's 75,000 steps.

Supervisor, ledger, spool, object store, learner, fits, commit and checkpoint are the real ones; the workers replay
recorded episodes under new numbers, since to simulate 1,200,000 steps would take ten minutes. Each size runs in a
process of its own, whose memory nothing else has touched.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from t6gps.service import config as configuration
from t6gps.service.bench import replay
from t6gps.service.bench.rounds import Say
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.pool.state import RunState
from t6gps.service.ray_backend import processes
from t6gps.service.training import loop
from t6gps.storage import catalog, durable, ipc, spool
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

FACTORS = (1, 4, 16)
ITERATIONS_N = 2
"""The second one is measured: the action value leads in it."""
ROLES = {"learner": ("ray::LearnerActor",), "fits": ("ray::fit_class", "ray::IDLE")}
"""How the command lines of the processes begin, whose memory is reported beside the supervisor's."""
NOTE = (
    "iteration_Nx_*: a whole iteration of N times the recorded episodes, replayed by the workers; peak_mb is the "
    "largest resident memory of a process, shared memory and mapped files included"
)


class ReplayingWorker:
    """Runs plans by giving recorded episodes their numbers."""

    def __init__(self, _: object, folder: Path) -> None:
        self._files = sorted(folder.glob("*.arrow"))

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        """The recorded episode whose turn it is."""
        recorded = spool.read(self._files[plan.index % len(self._files)])
        numbers = {
            "episode_id": plan.episode_id,
            "iteration": plan.iteration,
            "index": plan.index,
            "seed": plan.seed,
            "policy_version": snapshot.version,
        }
        return replay.numbered(recorded, numbers)

    def position(self) -> tuple[int, list[dict[str, Any]]]:
        """As of an episode that has not begun."""
        return 0, []

    def close(self) -> None:
        """Nothing is open."""


def growth(episodes: Sequence[Episode], say: Say, factors: Sequence[int] = FACTORS) -> dict[str, float]:
    """Seconds and peak memory of an iteration with as many copies of recorded episodes as each factor says.

    iteration_4x_steps         control steps of an iteration with four copies
    iteration_4x_*_s           seconds of its phases, as in the table `iterations`; `commit_s` for commit and checkpoint
    iteration_4x_disk_mb       what an iteration leaves behind in the run's folder
    iteration_4x_*_peak_mb     largest resident memory of supervisor, learner, and a process that fits models
    """
    figures: dict[str, float] = {}
    fresh = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "recorded"
        folder.mkdir()
        for number, episode in enumerate(episodes):
            path = folder / f"{number:06d}.arrow"
            durable.hidden(path).write_bytes(ipc.pack(episode.frames, episode.summary))
            durable.publish(path)
        for factor in factors:
            with ProcessPoolExecutor(1, mp_context=fresh) as process:
                measured = process.submit(_iterate, folder, factor * len(episodes)).result()
            figures |= {f"iteration_{factor}x_{key}": value for key, value in measured.items()}
            words = ", ".join(f"{role} {measured[f'{role}_peak_mb']:.0f} MB" for role in ("supervisor", "learner"))
            say(f"{factor} times the data: {words}")
    return figures


class _Clock:
    """Notes when each iteration is over, and its row."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.ends_s = [time.perf_counter()]

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        """Nobody looks."""

    def finished(self, row: dict[str, Any]) -> None:
        """An iteration is committed."""
        self.rows.append(row)
        self.ends_s.append(time.perf_counter())


def _iterate(folder: Path, episodes_n: int) -> dict[str, float]:
    """Figures of the last iteration, in this process and those that it starts."""
    overrides = [f"run.episodes={episodes_n}", f"run.iterations={ITERATIONS_N}", "learner.value_from=1"]
    config, clock = configuration.load("rough", overrides), _Clock()
    run = catalog.create(folder.parent, f"growth-{episodes_n}", config.to_json())
    with (
        catalog.locked(run),
        closing(RayExecutor(config, run, partial(ReplayingWorker, folder=folder))) as executor,
    ):
        loop.train(config, run, executor, clock)
        peaks = {role: peak_mb(begin) for role, begin in ROLES.items()}
        peaks["supervisor"] = processes.peak_mb(os.getpid())
        executor.close(RunState.DONE)
    row, took_s = clock.rows[-1], clock.ends_s[-1] - clock.ends_s[-2]
    phases = {name: row[name] for name in row if name.endswith(("ing_s", "pass_s", "supervised_s"))}
    return {
        "steps": row["steps"],
        **phases,
        "commit_s": took_s - sum(phases.values()),
        "disk_mb": sum(path.stat().st_size for path in run.path.rglob("*") if path.is_file()) / ITERATIONS_N / 1e6,
        **{f"{role}_peak_mb": peak for role, peak in peaks.items()},
    }


def peak_mb(begin: tuple[str, ...]) -> float:
    """The largest peak of the processes below this one whose command lines begin so; 0 when there is none."""
    below = processes.descendants(os.getpid())
    return max((processes.peak_mb(pid) for pid in below if processes.command(pid).startswith(begin)), default=0.0)
