"""Efficiency of the service beside a plain loop and beside pipes, its latencies, and a simulated large pool."""

from __future__ import annotations

import signal
from dataclasses import dataclass

import numpy as np

from t6gps.service import checks
from t6gps.service.bench import latency, rounds
from t6gps.service.bench.contenders import PRESET, Job, pipes, raw, rough_job, service
from t6gps.service.bench.rounds import Contender, Say
from t6gps.service.bench.scaling import large_pool
from t6gps.storage.errors import ConfigError

SECONDS, ROUNDS = 30.0, 5
NOTES = (
    f"episodes of preset {PRESET}, untrained policy; service and pipes record and keep what they sample, raw does not",
    "with Gymnasium's AsyncVectorEnv and RLlib in the same rounds, from a checkout: make bench-libraries",
    large_pool.NOTE,
)


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    seconds, rounds      of each contender's turns
    versions_n           new policies whose way to the workers is timed
    kills_n, hangs_n     workers that get SIGKILL or SIGSTOP
    pools, large_pool_s  sizes of the simulated pools, and the seconds of each
    """

    seconds: float = SECONDS
    rounds: int = ROUNDS
    versions_n: int = 30
    kills_n: int = 20
    hangs_n: int = 10
    pools: tuple[int, ...] = (10, 100, 1000)
    large_pool_s: float = 10.0

    @classmethod
    def within(cls, seconds: float, rounds: int) -> Sizes:
        """Sizes for such turns: less time than the default means fewer faults and smaller pools."""
        whole = cls()
        share = min(1.0, seconds * rounds / (whole.seconds * whole.rounds))
        versions_n, kills_n, hangs_n, *pools = (
            max(1, round(number * share)) for number in (whole.versions_n, whole.kills_n, whole.hangs_n, *whole.pools)
        )
        return cls(seconds, rounds, versions_n, kills_n, hangs_n, tuple(pools), min(seconds, whole.large_pool_s))


def pool(say: Say, seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, float | None]:
    """Everything that `t6gps bench pool` reports, from turns of such length and number (`measure`).

    ConfigError when the numbers make no measurement, or when RAY_ADDRESS names a cluster.
    """
    if seconds <= 0 or rounds < 1:
        raise ConfigError(f"bench pool needs seconds > 0 and rounds >= 1, found {seconds:g} and {rounds}")
    check_local("pool")
    return measure(Sizes.within(seconds, rounds), say)


def check_local(bench: str) -> None:
    """ConfigError when RAY_ADDRESS names a cluster."""
    if checks.cluster_address() is not None:
        raise ConfigError(f"bench {bench} measures this machine, found RAY_ADDRESS set; unset it")


def measure(sizes: Sizes, say: Say) -> dict[str, float | None]:
    """The figures by name.

    raw_N_steps_per_s            control steps per second of a plain loop in each of N processes
    efficiency_N                 committed control steps per second of the service over those of the same round
    cpu_efficiency_N             the same for the share of the machine's processor time that goes into simulation
    efficiency_2_pipes, cpu_efficiency_2_pipes     the same for processes joined by pipes
    cpu_s_per_1000_steps_ROLE    processor time (s) for 1,000 committed steps of two workers
    weight_latency_p95_s         from a new policy to a worker that acts with it
    kill_recovery_p95_s, hang_recovery_p95_s     from SIGKILL or SIGSTOP to the successor's first accepted episode,
                                                 the deadline included
    pool_N_*                     `large_pool.large_pool`
    """
    job = rough_job(2, sizes.seconds)
    result = _efficiency(sizes, say) | _latencies(job, sizes)
    return result | large_pool.large_pool(job, sizes.pools, sizes.large_pool_s)


def _efficiency(sizes: Sizes, say: Say) -> dict[str, float | None]:
    single, double = (rough_job(workers, sizes.seconds) for workers in (1, 2))
    contenders = [
        Contender("raw_1", single, raw),
        Contender("efficiency_1", single, service),
        Contender("raw_2", double, raw),
        Contender("efficiency_2", double, service),
        Contender("efficiency_2_pipes", double, pipes),
    ]
    tallies = rounds.take_turns(contenders, sizes.rounds, say)
    result: dict[str, float | None] = {}
    for contender in contenders:
        measured, plain = tallies[contender.name], tallies[f"raw_{contender.job.workers}"]
        if measured is plain:
            result[f"{contender.name}_steps_per_s"] = rounds.steps_per_s(measured)
        else:
            result[contender.name] = rounds.efficiency(measured, plain)
            result[f"cpu_{contender.name}"] = rounds.cpu_efficiency(measured, plain)
    served = tallies["efficiency_2"]
    for role in served[0].spent_s:
        seconds = [1e3 * tally.spent_s[role] / tally.steps_n for tally in served]
        result[f"cpu_s_per_1000_steps_{role}"] = float(np.median(seconds))
    return result


def _latencies(job: Job, sizes: Sizes) -> dict[str, float | None]:
    weights_s = latency.weight_latencies(job, sizes.versions_n)
    took_s = latency.recoveries(job, {signal.SIGKILL: sizes.kills_n, signal.SIGSTOP: sizes.hangs_n})
    return {
        "weight_latency_p95_s": float(np.quantile(weights_s, 0.95)),
        "kill_recovery_p95_s": float(np.quantile(took_s[signal.SIGKILL], 0.95)),
        "hang_recovery_p95_s": float(np.quantile(took_s[signal.SIGSTOP], 0.95)),
    }
