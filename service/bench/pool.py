"""Efficiency of the service beside a plain loop and its peers, its latencies, and a simulated large pool.

Contenders take turns within a round, and rounds alternate their order, so that a machine that slows down or speeds up
hits all of them. Every ratio is one to the plain loop of the same round; medians over rounds.
"""

from __future__ import annotations

import importlib
import os
import signal
from collections.abc import Callable
from functools import partial

import numpy as np

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench import large_pool, latency
from t6gps.service.bench.contenders import Job, pipes, raw, service
from t6gps.service.bench.tally import Tally
from t6gps.service.execution.wiring import new_learner
from t6gps.service.views.terminal import console
from t6gps.storage.errors import ConfigError

SECONDS, ROUNDS = 30.0, 5
MOST_EPISODES_PER_S = 20
"""More than a process simulates of the paper's episodes."""
VERSIONS_N, KILLS_N, HANGS_N = 30, 20, 10
SIZES, LARGE_POOL_S = (10, 100, 1000), 10.0
PRESET = "rough"
NOTES = (
    f"episodes of preset {PRESET}, untrained policy; peers neither record nor keep what they sample, pipes do both",
    large_pool.NOTE,
)


def pool(seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, float | None]:
    """Everything that `t6gps bench pool` reports; None for a peer that is not installed.

    raw_N_steps_per_s            control steps per second of a plain loop in each of N processes
    efficiency_N                 committed control steps per second of the service over those of the same round
    cpu_efficiency_N             the same for the share of the machine's processor time that goes into simulation
    efficiency_2_pipes, cpu_efficiency_2_pipes, efficiency_2_async_vector_env, efficiency_2_rllib
                                 the same for the peers
    cpu_s_per_1000_steps_ROLE    processor time (s) for 1,000 committed steps of two workers
    weight_latency_p95_s         from a new policy to a worker that acts with it (30 versions)
    kill_recovery_p95_s, hang_recovery_p95_s     from SIGKILL or SIGSTOP to the successor's first accepted episode
                                                 (20 and 10 times, the deadline included)
    pool_N_*                     `large_pool.large_pool`

    A shorter measurement than the default has fewer faults and smaller pools. ConfigError when the numbers make no
    measurement, or when RAY_ADDRESS names a cluster.
    """
    if seconds <= 0 or rounds < 1:
        raise ConfigError(f"bench pool needs seconds > 0 and rounds >= 1, found {seconds:g} and {rounds}")
    if "RAY_ADDRESS" in os.environ:
        raise ConfigError("bench pool measures this machine, found RAY_ADDRESS set; unset it")
    share = min(1.0, seconds * rounds / (SECONDS * ROUNDS))
    job = partial(_job, seconds=seconds)
    result = _efficiency(job, rounds) | _latencies(job(2), share)
    sizes = tuple(max(1, round(size * share)) for size in SIZES)
    return result | large_pool.large_pool(job(2), sizes, min(seconds, LARGE_POOL_S))


def _job(workers: int, seconds: float) -> Job:
    episodes = round(MOST_EPISODES_PER_S * workers * (seconds + 10))
    config = configuration.load(PRESET, [f"run.workers={workers}", f"run.episodes={episodes}"])
    return Job(config, seeding.training_plans(config, 0), new_learner(config).policy(), seconds)


def _efficiency(job: Callable[[int], Job], rounds: int) -> dict[str, float | None]:
    cpu_s: list[dict[str, float]] = []

    def timed_service(given: Job) -> Tally:
        tally, spent_s = service(given)
        cpu_s.append({role: 1e3 * seconds / tally.steps_n for role, seconds in spent_s.items()})
        return tally

    one = {"raw_1": raw, "efficiency_1": lambda given: service(given)[0]}
    two = {"raw_2": raw, "efficiency_2": timed_service, "efficiency_2_pipes": pipes} | _peers()
    turns = [(name, job(n), run) for n, contenders in ((1, one), (2, two)) for name, run in contenders.items()]
    speeds: dict[str, list[float]] = {name: [] for name, _, run in turns if run is not None}
    shares: dict[str, list[float]] = {name: [] for name in speeds}
    for number in range(rounds):
        for name, given, run in turns if number % 2 == 0 else reversed(turns):
            if run is not None:
                tally = run(given)
                speeds[name].append(tally.steps_per_s)
                shares[name].append(tally.simulating)
                words = f"round {number + 1} of {rounds}: {name} {tally.steps_per_s:.0f} steps/s"
                console.print(
                    words + (f", simulates {tally.simulating:.2%}" if tally.simulating else ""), highlight=False
                )
    result: dict[str, float | None] = {}
    for name, given, _ in turns:
        if name.startswith("raw"):
            result[f"{name}_steps_per_s"] = float(np.median(speeds[name]))
        else:
            result[name] = _ratio(speeds, name, given.workers)
            if name in shares and all(shares[name]):
                result[f"cpu_{name}"] = _ratio(shares, name, given.workers)
    medians = {role: float(np.median([spent[role] for spent in cpu_s])) for role in cpu_s[0]}
    return result | {f"cpu_s_per_1000_steps_{role}": seconds for role, seconds in medians.items()}


def _ratio(found: dict[str, list[float]], name: str, workers: int) -> float | None:
    """The median over rounds of a contender's figure over that of the plain loop; None when it took no part."""
    return float(np.median(found[name] / np.array(found[f"raw_{workers}"]))) if name in found else None


def _peers() -> dict[str, Callable[[Job], Tally] | None]:
    """The peers that are libraries, None for one that is not installed."""
    found: dict[str, Callable[[Job], Tally] | None] = {}
    for name, module in (("async_vector_env", "libraries"), ("rllib", "rllib_policy")):
        found[f"efficiency_2_{name}"] = None
        try:
            importlib.import_module(f"t6gps.service.bench.{module}")
            from t6gps.service.bench import libraries

            found[f"efficiency_2_{name}"] = getattr(libraries, name)
        except ImportError as error:
            words = f"{name} takes no part: {error}; pip install 't6gps[peers]'"
            console.print(words, markup=False, highlight=False, soft_wrap=True)
    return found


def _latencies(job: Job, share: float) -> dict[str, float | None]:
    times = {signal.SIGKILL: KILLS_N, signal.SIGSTOP: HANGS_N}
    weights_s = latency.weight_latencies(job, max(1, round(VERSIONS_N * share)))
    took_s = latency.recoveries(job, {number: max(1, round(n * share)) for number, n in times.items()})
    return {
        "weight_latency_p95_s": float(np.quantile(weights_s, 0.95)),
        "kill_recovery_p95_s": float(np.quantile(took_s[signal.SIGKILL], 0.95)),
        "hang_recovery_p95_s": float(np.quantile(took_s[signal.SIGSTOP], 0.95)),
    }
