"""What a contender of the benchmark did: control steps by the clock, and its share of the machine for simulation.

The clock sees the machine itself change its speed, by a tenth from one half minute to the next where others share it.
Both sides of the share slow down together; but it does not see what disturbs the simulation itself, as caches do.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker


@dataclass
class Tally:
    """Control steps that were done, and when (s, the clock of `time.monotonic`, which all processes share).

    seconds       how long is counted
    machine_s     `machine_s` at the first entry and at the last
    simulating    share of the machine's processor time that went into simulation meanwhile; 0 where nobody notes it
    spent_s       processor time of each role meanwhile (s), where there are roles
    """

    seconds: float
    done: list[tuple[float, int]] = field(default_factory=list)
    machine_s: list[float] = field(default_factory=list)
    simulating: float = 0.0
    spent_s: dict[str, float] = field(default_factory=dict)

    def add(self, steps: int) -> bool:
        """Count steps that are done now; True when the time is up."""
        self.done.append((time.monotonic(), steps))
        if len(self.done) == 1 or self.is_over:
            self.machine_s.append(machine_s())
        return self.is_over

    @property
    def is_over(self) -> bool:
        """True when `seconds` have passed since the first entry, and one came after it."""
        return len(self.done) > 1 and self.took_s >= self.seconds

    @property
    def took_s(self) -> float:
        """From the first entry to the last."""
        return self.done[-1][0] - self.done[0][0]

    @property
    def steps_n(self) -> int:
        """Steps from the first entry on, without its own."""
        return sum(steps for _, steps in self.done[1:])

    @property
    def steps_per_s(self) -> float:
        """Control steps per second from the first entry to the last."""
        return self.steps_n / self.took_s

    def read(self, notes: Iterable[Path]) -> None:
        """Set `simulating` from what the processes that simulate have noted meanwhile."""
        begin_s, end_s = self.done[0][0], self.done[-1][0]
        rates = [_simulated_per_s(path, begin_s, end_s) for path in notes]
        self.simulating = sum(rates) * self.took_s / (self.machine_s[-1] - self.machine_s[0])


class NotingWorker(RolloutWorker):
    """Notes when an episode was done and the processor time that it took, in a file of its process in `folder`."""

    def __init__(self, settings: RolloutSettings, folder: Path) -> None:
        super().__init__(settings)
        self._notes = (folder / str(os.getpid())).open("a", buffering=1)

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        begin_s = time.thread_time()
        episode = super().run(plan, snapshot)
        self._notes.write(f"{time.monotonic()} {time.thread_time() - begin_s}\n")
        return episode


def steps_of(episode: Episode) -> int:
    """Control steps of an episode."""
    return int(episode.summary["steps"][0].as_py())


def machine_s() -> float:
    """Time of all cores since this machine has started (s), busy or idle, without what its host gave to others."""
    ticks = [int(field) for field in Path("/proc/stat").read_text().partition("\n")[0].split()[1:8]]
    return sum(ticks) / os.sysconf("SC_CLK_TCK")


def _simulated_per_s(notes: Path, begin_s: float, end_s: float) -> float:
    """Processor seconds per second that a process simulated, from its first note between two instants to its last."""
    lines = [tuple(map(float, line.split())) for line in notes.read_text().splitlines()]
    meanwhile = [(done_s, cpu_s) for done_s, cpu_s in lines if begin_s <= done_s <= end_s]
    if len(meanwhile) < 2:
        return 0.0
    return sum(cpu_s for _, cpu_s in meanwhile[1:]) / (meanwhile[-1][0] - meanwhile[0][0])
