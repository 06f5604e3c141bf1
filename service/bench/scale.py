"""How far one head carries, on paper: what N workers need of it in time, network, disk and memory.

Costs of an episode are measured here and now; what many workers need is computed from them. Only the supervisor's
decisions are simulated for each number of workers (`paper_pool`), since they alone grow with it. Workers sample all the
time, each as fast as a core of this machine, and an iteration has EPISODES_PER_WORKER episodes for each.

    N, r     workers, and the episodes of all of them in a second
    c(N)     seconds of the supervising thread per episode: deciding, Ray's calls, spool
    need     r times the cost of an episode, or N times what a worker needs; it must not exceed what a head has
"""

from __future__ import annotations

import os
import time
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service.bench import learner
from t6gps.service.bench.contenders import rough_job
from t6gps.service.bench.pool import check_local
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.scaling import growth, large_pool
from t6gps.service.bench.scaling.paper_pool import deciding_s
from t6gps.service.config import Config
from t6gps.service.execution.wiring import new_learner
from t6gps.service.pool.state import PoolState
from t6gps.service.seeding import training_plans
from t6gps.storage import ipc
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.worker import RolloutWorker

SIZES = (10, 100, 1_000, 10_000)
EPISODES_N, FEW, MANY = 100, 1, 4
"""Recorded episodes, and how often two iterations have each of them."""
SLOTS_N, SLOTS_S, DECIDED_N, TIMED_N = 100, 8.0, 2_000, 5
"""Simulated workers with Ray's calls and the disk, and their seconds; episodes on paper, and in a worker."""
EPISODES_PER_WORKER, MOST_N = 10, 10_000_000
HEAD = {
    "supervising_s": 1.0,  # a thread has a second in a second
    "learning_s": 1.0,  # learning takes as long as the sampling that it follows
    "network_mb": 1250.0,  # 10 Gbit/s
    "disk_mb": 1000.0,
    "memory_gb": 64.0,
    "under_way_gb": PoolState.bytes_in_flight / 1e9,
}
"""What the head has, by need: the first four a second."""
THREADS = os.cpu_count()
NOTES = (
    "episodes of preset rough; N_workers_X is what N workers need: a share of a thread's second, seconds of learning "
    "and commit per second of sampling, MB a second, GB",
    f"most_workers_X: where X reaches {', '.join(f'{need} {most:g}' for need, most in HEAD.items())}; "
    "the smallest of them breaks first",
    f"an iteration has {EPISODES_PER_WORKER} episodes for each worker",
)


@dataclass(frozen=True)
class IterationCosts:
    """What an episode costs after it was sampled.

    learner_s, commit_s   the learner's phases by name, and what follows them
    disk_mb, memory_mb    what stays on disk, and memory of the head
    base_mb               memory of the head without any episode
    """

    learner_s: Mapping[str, float]
    commit_s: float
    disk_mb: float
    memory_mb: float
    base_mb: float


@dataclass(frozen=True)
class Costs:
    """What an episode costs.

    episode_s            of a worker's time
    episode_mb           of the network;   policy_mb    of the network, for a policy that a worker pulls
    worker_mb            memory of a worker's process
    decisions            workers, and the supervisor's seconds with so many
    calls_s, spool_s     of the supervising thread: Ray's calls, and to force it to disk
    """

    episode_s: float
    episode_mb: float
    policy_mb: float
    worker_mb: float
    decisions: tuple[tuple[int, float], ...]
    calls_s: float
    spool_s: float
    iteration: IterationCosts

    def deciding_s(self, workers_n: int) -> float:
        """The supervisor's seconds per episode with so many workers; from the largest number on they grow with it."""
        sizes, decided_s = np.array(self.decisions).T
        return float(np.interp(workers_n, sizes, decided_s)) * max(workers_n / float(sizes[-1]), 1.0)

    def figures(self) -> dict[str, float]:
        """The costs by name, times in ms."""
        iteration = self.iteration
        seconds = {"episode": self.episode_s, "calls": self.calls_s, "spool": self.spool_s}
        seconds |= {f"deciding_{workers_n}": decided_s for workers_n, decided_s in self.decisions}
        seconds |= {**iteration.learner_s, "commit": iteration.commit_s}
        return {f"{name}_ms": 1e3 * spent_s for name, spent_s in seconds.items()} | {
            "episode_mb": self.episode_mb,
            "policy_mb": self.policy_mb,
            "disk_mb": iteration.disk_mb,
            "memory_mb": iteration.memory_mb,
            "worker_mb": self.worker_mb,
        }


def scale(say: Say) -> dict[str, float | None]:
    """Everything that `t6gps bench scale` reports: costs of an episode, needs of many workers, and the most workers.

    ConfigError when RAY_ADDRESS names a cluster.
    """
    check_local("scale")
    measured = costs(say)
    result: dict[str, float | None] = dict(measured.figures())
    for workers_n in SIZES:
        result |= {f"{workers_n}_workers_{need}": amount for need, amount in needs(measured, workers_n).items()}
    return result | {f"most_workers_{need}": float(most) for need, most in most_workers(measured).items()}


def needs(costs: Costs, workers_n: int) -> dict[str, float]:
    """What so many workers need of the head, by the names of HEAD."""
    iteration, per_s = costs.iteration, workers_n / costs.episode_s
    batch_n, batch_s = EPISODES_PER_WORKER * workers_n, EPISODES_PER_WORKER * costs.episode_s
    return {
        "supervising_s": per_s * (costs.deciding_s(workers_n) + costs.calls_s + costs.spool_s),
        "learning_s": per_s * (sum(iteration.learner_s.values()) + iteration.commit_s),
        "network_mb": per_s * costs.episode_mb + workers_n * costs.policy_mb / batch_s,
        "disk_mb": per_s * (costs.episode_mb + iteration.disk_mb),
        "memory_gb": (iteration.base_mb + batch_n * iteration.memory_mb) / 1e3,
        "under_way_gb": workers_n * costs.episode_mb / 1e3,
    }


def most_workers(costs: Costs) -> dict[str, int]:
    """How many workers the head carries before it lacks something, by the names of HEAD; no more than MOST_N."""
    return {
        need: bisect_right(range(1, MOST_N + 1), has, key=lambda n: needs(costs, n)[need]) for need, has in HEAD.items()
    }


def costs(say: Say) -> Costs:
    """What an episode costs, measured in about three minutes on two idle cores."""
    config = configuration.load("rough", [f"run.episodes={EPISODES_N}"])
    with learner.rolling(config, say) as sampled:
        episodes, worker_mb = sampled, growth.peak_mb(("ray::WorkerActor",))
    policy = new_learner(config).policy()
    say(f"{SLOTS_N} simulated workers for {SLOTS_S:g} s")
    slots = large_pool.large_pool(rough_job(2, SLOTS_S), (SLOTS_N,), SLOTS_S)
    grown = growth.growth(episodes, say, (FEW, MANY))
    episode_s = _episode_s(config, policy)
    decisions = []
    for workers_n in SIZES:
        decisions.append((workers_n, deciding_s(config, workers_n, episodes[0], episode_s, DECIDED_N)))
        say(f"{workers_n:,} workers on paper: {1e3 * decisions[-1][1]:.2f} ms for an episode")
    return Costs(
        episode_s=episode_s,
        episode_mb=ipc.pack(episodes[0].frames, episodes[0].summary).size / 1e6,
        policy_mb=sum(array.nbytes for layer in policy.layers for array in layer) / 1e6,
        worker_mb=worker_mb,
        decisions=tuple(decisions),
        calls_s=slots[f"pool_{SLOTS_N}_calls_ms"] / 1e3,
        spool_s=(slots[f"pool_{SLOTS_N}_committer_ms"] + slots[f"pool_{SLOTS_N}_commit_wait_ms"]) / 1e3,
        iteration=of_iterations(grown, len(episodes)),
    )


def of_iterations(grown: Mapping[str, float], episodes_n: int) -> IterationCosts:
    """The costs that the figures of `growth.growth` mean, for so many recorded episodes.

    Seconds are those of the larger iteration over its episodes. Differences of seconds would be too noisy.
    """
    few_n, many_n = FEW * episodes_n, MANY * episodes_n
    few, many = (
        {key.removeprefix(start): value for key, value in grown.items() if key.startswith(start)}
        for start in (f"iteration_{FEW}x_", f"iteration_{MANY}x_")
    )
    few_mb, many_mb = (figures["supervisor_peak_mb"] + figures["learner_peak_mb"] for figures in (few, many))
    memory_mb = (many_mb - few_mb) / (many_n - few_n)
    return IterationCosts(
        learner_s={phase.name: many[phase.duration_column] / many_n for phase in PHASES},
        commit_s=many["commit_s"] / many_n,
        disk_mb=(many["disk_mb"] - few["disk_mb"]) / (many_n - few_n),
        memory_mb=memory_mb,
        base_mb=few_mb - few_n * memory_mb,
    )


def _episode_s(config: Config, policy: PolicySnapshot) -> float:
    """Processor time of an episode in a worker (s), the first one left out."""
    taken_s = []
    with closing(RolloutWorker(config.rollout)) as worker:
        for plan in training_plans(config, 0)[: TIMED_N + 1]:
            begin_s = time.thread_time()
            worker.run(plan, policy)
            taken_s.append(time.thread_time() - begin_s)
    return float(np.mean(taken_s[1:]))
