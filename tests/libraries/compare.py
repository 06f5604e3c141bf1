"""Measures the service beside Gymnasium's AsyncVectorEnv and RLlib, in the same rounds: `make bench-libraries`.

Prints one JSON object: where the figures come from, control steps per second of a plain loop in two processes, and the
speed of each contender over that loop's of the same round, medians over rounds.
"""

from __future__ import annotations

import argparse
import sys

from library_contenders import async_vector_env, rllib

from t6gps.service.bench import pool, rounds
from t6gps.service.bench.contenders import raw, rough_job, service
from t6gps.service.bench.registry import Measurement
from t6gps.service.bench.rounds import Contender, Say
from t6gps.service.provenance import provenance

WORKERS_N = 2


def measure(seconds: float, rounds_n: int, say: Say) -> dict[str, float]:
    """The figures by name, from turns of such length and number."""
    pool.check_local("pool")
    job = rough_job(WORKERS_N, seconds)
    contenders = [
        Contender("raw_2", job, raw),
        Contender("efficiency_2", job, service),
        Contender("efficiency_2_async_vector_env", job, async_vector_env),
        Contender("efficiency_2_rllib", job, rllib),
    ]
    tallies = rounds.take_turns(contenders, rounds_n, say)
    plain = tallies.pop("raw_2")
    ratios = {name: rounds.efficiency(measured, plain) for name, measured in tallies.items()}
    return {"raw_2_steps_per_s": rounds.steps_per_s(plain), **ratios}


def main() -> None:
    parser = argparse.ArgumentParser(description="The service beside AsyncVectorEnv and RLlib, in the same rounds.")
    parser.add_argument("--seconds", type=float, default=pool.SECONDS, help="of each turn")
    parser.add_argument("--rounds", type=int, default=pool.ROUNDS, help="turns of each contender")
    chosen = parser.parse_args()
    figures = measure(chosen.seconds, chosen.rounds, lambda line: print(line, file=sys.stderr))
    print(Measurement("libraries", provenance(), 1, (), dict(figures)).to_json())


if __name__ == "__main__":
    main()
