"""`t6gps bench surrogate RUN`: what backward pass and action value promise, and what the simulator makes of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from t6gps.service.bench.rounds import Say
from t6gps.service.bench.surrogate.agreement import Figures
from t6gps.service.bench.surrogate.branches import branch_test
from t6gps.service.bench.surrogate.gradients import gradient_test
from t6gps.service.bench.surrogate.prediction import prediction_test
from t6gps.service.bench.surrogate.stored import load, promised_mean
from t6gps.storage.catalog import Run

SHARES = {"": 1.0, "_quarter": 0.25}
"""Shares of a change, by what they add to the names of figures."""
PIECES, STATES = 200, 600
NOTES = (
    "branch: change of the running cost per step (m2/s2); pass, value: u* of the backward pass and of the action "
    "value; network: what the next policy took up",
    "gradient: cost of the next control steps by the first effective action; slope and correlation of realised over "
    "promised, with 95 % intervals over episodes",
)


def surrogate(
    say: Say,
    run: Run,
    iteration: int | None = None,
    pieces: int = PIECES,
    states: int = STATES,
    seed: int = 0,
    overrides: Sequence[str] = (),
) -> Figures:
    """Judge an iteration of a run, by default the last one that the backward pass led; one to two minutes.

    pieces, states   how many the branch test and the gradient test have
    seed             of what is drawn: pieces, states, signs, episodes held out, resampled episodes
    overrides        settings of the learner that are judged on the same episodes in the place of the run's

    Errors as `stored.load`; DataError for an iteration with too few episodes or steps.
    """
    stored = load(run, iteration, say, overrides)
    streams = [np.random.default_rng(each) for each in np.random.SeedSequence(seed).spawn(3)]
    figures: Figures = {
        "iteration": float(stored.iteration),
        "seed": float(seed),
        "led_by_action_value": float(stored.led_by_value),
        "predicted_cost_change": promised_mean(stored),
    }
    say("held-out error")
    figures |= prediction_test(stored, streams[0])
    say(f"branch test: {pieces} pieces")
    figures |= branch_test(stored, pieces, SHARES, streams[1])
    say(f"gradient test: {states} states")
    return figures | gradient_test(stored, states, streams[2])
