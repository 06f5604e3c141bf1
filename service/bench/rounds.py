"""Contenders that take turns, so that a machine that slows down or speeds up hits all of them.

Each has one turn in a round, and rounds alternate their order. A ratio compares figures of the same round.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from t6gps.service.bench.contenders import Job
from t6gps.service.bench.tally import Tally

Say = Callable[[str], None]
"""Takes a line that says how far a benchmark is."""


@dataclass(frozen=True)
class Contender:
    """A way to run a job, and the job that it gets."""

    name: str
    job: Job
    run: Callable[[Job], Tally]


def take_turns(contenders: Sequence[Contender], rounds: int, say: Say) -> dict[str, list[Tally]]:
    """Tallies of each contender by its name, one for each round."""
    tallies: dict[str, list[Tally]] = {contender.name: [] for contender in contenders}
    for number in range(rounds):
        for contender in contenders if number % 2 == 0 else reversed(contenders):
            tally = contender.run(contender.job)
            tallies[contender.name].append(tally)
            share = f", simulates {tally.simulating:.2%}" if tally.simulating else ""
            say(f"round {number + 1} of {rounds}: {contender.name} {tally.steps_per_s:.0f} steps/s{share}")
    return tallies


def steps_per_s(tallies: Sequence[Tally]) -> float:
    """Median over rounds."""
    return float(np.median([tally.steps_per_s for tally in tallies]))


def efficiency(tallies: Sequence[Tally], reference: Sequence[Tally]) -> float:
    """Median over rounds of the speed over that of the reference in the same round."""
    pairs = zip(tallies, reference, strict=True)
    return float(np.median([tally.steps_per_s / plain.steps_per_s for tally, plain in pairs]))


def cpu_efficiency(tallies: Sequence[Tally], reference: Sequence[Tally]) -> float | None:
    """The same ratio for the share of the machine's processor time that goes into simulation.

    None where no round of the reference lasted long enough: it takes a process three episodes to know.
    """
    pairs = zip(tallies, reference, strict=True)
    ratios = [tally.simulating / plain.simulating for tally, plain in pairs if plain.simulating]
    return float(np.median(ratios)) if ratios else None
