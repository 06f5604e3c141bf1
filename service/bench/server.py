"""`t6gps serve` beside a running pool: how long a status takes where there are many clients, and what the pool loses.

Turns of the pool with clients and without alternate. Server and clients are processes of their own, on the machine
whose cores the workers use.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from t6gps.service.bench import rounds as turns
from t6gps.service.bench.clients import ASKING_N, DEAD_N, EVERY_S, LARGE, SLOW_N, clients
from t6gps.service.bench.contenders import Enough, opened, rough_job
from t6gps.service.bench.pool import check_local
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.tally import Tally, steps_of
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.records import Episode

SECONDS, ROUNDS = 30.0, 5
SETTLING_S = 2.0
"""Between turns: clients come and go."""
LARGE_BYTES = 2**26
NOTES = (
    f"{ASKING_N + SLOW_N + DEAD_N} clients: {ASKING_N} ask for the status every {EVERY_S:g} s, {SLOW_N} take a large "
    f"answer slowly, {DEAD_N} take nothing of a large answer or of the live events",
    "the pool has a worker for each core, which server and clients use as well",
)


@dataclass
class Turns:
    """Turns of the pool, which clients are at work in those of odd numbers.

    connection   to the process of the clients
    server       process of the server
    clients      process of the clients
    """

    seconds: float
    rounds: int
    say: Say
    connection: Connection
    server: int
    clients: int
    tallies: dict[bool, list[Tally]] = field(default_factory=lambda: {False: [], True: []})
    latencies_s: list[float] = field(default_factory=list)
    server_s: float = 0.0
    clients_s: float = 0.0
    busy_s: float = 0.0
    settled_s: float = float("inf")

    def begin(self) -> None:
        """Begin the first turn."""
        self._begin(False)

    def add(self, steps: int) -> None:
        """Count steps of the pool. Raises Enough after the last turn, RunError for a wrong answer to a client."""
        if time.monotonic() < self.settled_s or not self._tally.add(steps):
            return
        busy = self._busy
        self.tallies[busy].append(self._tally)
        if busy:
            self._end_clients()
        self.say(f"{'with' if busy else 'without'} clients {self._tally.steps_per_s:.0f} steps/s")
        done_n = sum(map(len, self.tallies.values()))
        if done_n == 2 * self.rounds:
            raise Enough
        self._begin(done_n % 4 in (1, 2))  # without, with, with, without: what drifts hits both alike

    def _begin(self, busy: bool) -> None:
        self._busy, self._tally = busy, Tally(self.seconds)
        self.settled_s = time.monotonic() + SETTLING_S
        if busy:
            self.connection.send(True)
            self._count(-1)

    def _end_clients(self) -> None:
        self._count(1)
        self.connection.send(False)
        latencies_s, wrong = self.connection.recv()
        if wrong:
            raise RunError(f"the server answered {len(wrong)} clients wrongly, such as {wrong[0]}; see its log")
        self.latencies_s += latencies_s

    def _count(self, sign: int) -> None:
        self.server_s += sign * _cpu_s(self.server)
        self.clients_s += sign * _cpu_s(self.clients)
        self.busy_s += sign * time.monotonic()


def server(say: Say, seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, float | None]:
    """Everything that `t6gps bench server` reports, from turns of such length and number (`measure`).

    ConfigError when the numbers make no measurement, or when RAY_ADDRESS names a cluster.
    """
    if seconds <= 0 or rounds < 1:
        raise ConfigError(f"bench server needs seconds > 0 and rounds >= 1, found {seconds:g} and {rounds}")
    check_local("server")
    return measure(say, seconds, rounds)


def measure(say: Say, seconds: float, rounds: int) -> dict[str, float | None]:
    """The figures by name.

    status_p50_ms, status_p95_ms   from a request of the status to the whole answer
    pool_ratio                     the pool's control steps per second with clients over those without
    pool_steps_per_s               of the pool without clients
    server_share, clients_share    processor time of either, by what all cores have in the turns with clients
    server_cpu_ms_per_status       processor time of the server for everything that it does, by statuses
    server_peak_mb                 the most memory that the server's process had at once
    """
    job = rough_job(os.cpu_count() or 1, 2 * rounds * (seconds + SETTLING_S))
    with opened(job.config) as (executor, spool), ExitStack() as stack:
        run = executor.run
        assert run is not None  # `opened` has made it
        stack.enter_context(catalog.locked(run))
        (run.figures / LARGE).write_bytes(bytes(LARGE_BYTES))
        process, url, token = stack.enter_context(_serving(run.path.parent))
        connection, asking = stack.enter_context(_clients(url, token, run.name))
        measured = Turns(seconds, rounds, say, connection, process, asking)
        measured.begin()

        def keep(episode: Episode) -> None:
            spool.append(episode)
            executor.feed(episode)
            measured.add(steps_of(episode))

        with suppress(Enough):
            executor.sample(job.plans, job.snapshot, keep)
        peak_mb = _peak_mb(process)
    return {**_figures(measured), "server_peak_mb": peak_mb}


def _figures(measured: Turns) -> dict[str, float | None]:
    quiet, busy, latencies_s = measured.tallies[False], measured.tallies[True], measured.latencies_s
    if len(busy) < measured.rounds or not latencies_s:
        raise RunError("the episodes ended before the turns did; measure for a shorter time")
    cores_s = measured.busy_s * (os.cpu_count() or 1)
    return {
        "status_p50_ms": 1e3 * float(np.quantile(latencies_s, 0.5)),
        "status_p95_ms": 1e3 * float(np.quantile(latencies_s, 0.95)),
        "pool_ratio": turns.efficiency(busy, quiet),
        "pool_steps_per_s": turns.steps_per_s(quiet),
        "server_share": measured.server_s / cores_s,
        "clients_share": measured.clients_s / cores_s,
        "server_cpu_ms_per_status": 1e3 * measured.server_s / len(latencies_s),
    }


@contextmanager
def _serving(root: Path) -> Iterator[tuple[int, str, str]]:
    """A server of a root: its process, its address and a token for it."""
    command = [sys.executable, "-m", "t6gps"]
    environment = {name: value for name, value in os.environ.items() if name != "T6GPS_SERVER"}
    create = [*command, "token", "create", "bench", "--days", "1", "--root", str(root)]
    token = subprocess.run(create, check=True, capture_output=True, text=True, env=environment).stdout.strip()
    serve = [*command, "serve", "--port", "0", "--root", str(root)]
    process = subprocess.Popen(serve, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    try:
        said = process.stderr.readline()
        address = re.search(r"http://\S+", said)
        if address is None:
            raise RunError(f"the server did not start: {said}{process.stderr.read()}")
        yield process.pid, address[0], token
    finally:
        process.terminate()
        process.communicate()


@contextmanager
def _clients(url: str, token: str, run: str) -> Iterator[tuple[Connection, int]]:
    """A pipe to the process of the clients, and that process."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=clients, args=(there, url, token, run), daemon=True)
    process.start()
    assert process.pid is not None  # it has started
    with closing(here):
        try:
            yield here, process.pid
        finally:
            process.kill()
            process.join()


def _cpu_s(pid: int) -> float:
    """Processor time of a process so far (s)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_mb(pid: int) -> float:
    """The most memory that a process has had at once (MB)."""
    peak = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert peak is not None, "the kernel says so of every process"
    return int(peak[1]) * 1024 / 1e6
