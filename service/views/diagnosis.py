"""What the tables `iterations` and `classes` say about a run, in words: the finding, its figure, and what to try."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypedDict


class IterationRow(TypedDict):
    """What the diagnosis reads of a row of `iterations`; None where there is none, or the run is older than it."""

    iteration: int
    policy_version: int
    cost: float
    cost_standard_error: float | None
    forward_speed_m_per_s: float
    stuck_share_by_distance: float | None
    modes: float
    predicted_cost_change: float
    supervised_loss_before: float | None
    supervised_loss: float
    policy_kl: float | None
    saturated_share: float | None


class ClassRow(TypedDict):
    """What the diagnosis reads of a row of `classes`."""

    iteration: int
    rows: int
    time_steps: int
    pooled: bool


Iterations = Sequence[IterationRow]
Classes = Sequence[ClassRow]

# Healthy runs of flat-quick, from which the limits keep a distance: 11 to 22 % of the rows in pools, at most 5 % of the
# commands saturated, stuck at most 0.5 % of the
# time by distance, 1.1 to 1.4 modes from the second iteration on.
STANDARD_ERRORS = 2.0
"""A rise of the cost counts beyond this many standard errors: by chance one iteration in forty does so."""
POOLED_SHARE = 1 / 3
"""A third of the rows in pools: the segmentation no longer says much about what is fitted."""
SATURATED_SHARE = 0.2
"""A fifth of the commands at an end of the range: about five of 24 cables cannot answer at any time."""
STANDING_SPEED_M_PER_S, STUCK_SHARE = 0.05, 0.2
"""A speed that is as good as none; a fifth of the time less than 5 cm in 1 s, where healthy runs on rough ground stay
below 8 %."""
LOSS_LEFT = 0.95
"""A network that takes up less than a twentieth of what it is shown does not follow the improved actions."""
MODES, ROWS_PER_STEP = 1.05, 250
"""A second mode needs twice as many outliers as regressors (126 of them for `nodes`), in bins twice that large."""


def diagnose(iterations: Iterations, classes: Classes) -> list[str]:
    """Sentences on a run with these rows of `iterations`, in any order and at least one, and of `classes`.

    Findings about learning compare iterations; the others concern the newest one. Columns that are null because the
    run is older than they are say nothing. A run without a finding is well.
    """
    ordered = sorted(iterations, key=lambda row: row["iteration"])
    newest = ordered[-1]
    if len(ordered) == 1:
        return ["Only the untrained policy has sampled so far; the next iteration shows what was learned from it."]
    present = [row for row in classes if row["iteration"] == newest["iteration"]]
    findings = (
        _step_too_large(ordered),
        _promise_not_kept(ordered),
        _standing_still(newest),
        _saturated(newest),
        _loss_not_falling(newest),
        _starved(present),
        _too_few_samples_for_modes(newest, present),
    )
    sentences = [finding for finding in findings if finding]
    if sentences:
        return sentences
    first = ordered[0]
    return [
        f"All well: the cost fell from {first['cost']:.3f} to {newest['cost']:.3f} m2/s2 in {len(ordered)} iterations "
        f"and the robot moves at {newest['forward_speed_m_per_s']:.2f} m/s towards its waypoints; "
        "more iterations or more episodes (run.iterations, run.episodes) may take it further."
    ]


def _origins(ordered: Iterations) -> dict[int, IterationRow]:
    """By iteration, the one that its policy was learned from: the one before it, or in a pipelined run before that."""
    by_number = {row["iteration"]: row for row in ordered}
    return {row["iteration"]: by_number[row["policy_version"] - 1] for row in ordered if row["policy_version"] > 0}


def _step_too_large(ordered: Iterations) -> str | None:
    rises, origins = [], _origins(ordered)
    for after in ordered:
        before = origins.get(after["iteration"])
        if before is None:
            continue
        error, later_error = before["cost_standard_error"], after["cost_standard_error"]
        rise = after["cost"] - before["cost"]
        if error is not None and later_error is not None and rise > STANDARD_ERRORS * math.hypot(error, later_error):
            rises.append((rise, before, after))
    if not rises:
        return None
    _, before, after = max(rises, key=lambda rise: rise[0])
    kl = "" if before["policy_kl"] is None else f", and moved the policy by {before['policy_kl']:.2f} nat"
    return (
        f"The step was too large: after iteration {before['iteration']} the cost rose from {before['cost']:.3f} to "
        f"{after['cost']:.3f} m2/s2, where the models promised a change of {before['predicted_cost_change']:.3f}{kl}; "
        "try a larger learner.kl_weight, or more data (run.episodes)."
    )


def _promise_not_kept(ordered: Iterations) -> str | None:
    origins, end = _origins(ordered), ordered[-1]
    middle = origins.get(end["iteration"])
    start = middle and origins.get(middle["iteration"])
    if middle is None or start is None:
        return None
    promised = start["predicted_cost_change"] + middle["predicted_cost_change"]
    realised = end["cost"] - start["cost"]
    if promised >= 0 or realised < 0:
        return None
    return (
        f"Learning has stopped: over the last two steps the cost went from {start['cost']:.3f} to "
        f"{end['cost']:.3f} m2/s2, where the models promised {promised:.3f} in all; "
        "try more data (run.episodes), or more weight on the pooled models (learner.prior_samples)."
    )


def _standing_still(newest: IterationRow) -> str | None:
    speed, stuck = newest["forward_speed_m_per_s"], newest["stuck_share_by_distance"]
    if speed >= STANDING_SPEED_M_PER_S and (stuck is None or stuck <= STUCK_SHARE):
        return None
    share = "" if stuck is None else f", {stuck:.0%} of the time less than 5 cm from where it was 1 s before"
    return (
        f"The robot stands still or goes nowhere: {speed:.3f} m/s towards the waypoint{share}; try more exploration "
        "(exploration.noise_std_m), faster winches (robot.winch_speed_m_per_s) or easier ground (terrain.difficulty), "
        "and keep the nodes in learner.reduced_state."
    )


def _saturated(newest: IterationRow) -> str | None:
    share = newest["saturated_share"]
    if share is None or share <= SATURATED_SHARE:
        return None
    return (
        f"The policy is saturated: {share:.0%} of its commands lie at an end of the command range; try a wider range "
        "(robot.shortest_command_m, robot.longest_command_m) or a larger learner.kl_weight."
    )


def _loss_not_falling(newest: IterationRow) -> str | None:
    before, after = newest["supervised_loss_before"], newest["supervised_loss"]
    if before is None or after <= LOSS_LEFT * before:
        return None
    return (
        f"The policy does not take up the improved actions: the loss of the supervised step went from {before:.3f} to "
        f"{after:.3f}; try more learner.epochs, another learner.learning_rate or wider learner.hidden_layers."
    )


def _starved(classes: Classes) -> str | None:
    rows = sum(row["rows"] for row in classes)
    pooled = sum(row["rows"] for row in classes if row["pooled"])
    if not rows or pooled <= POOLED_SHARE * rows:
        return None
    return (
        f"Classes are starved: {pooled / rows:.0%} of the rows lie in {sum(row['pooled'] for row in classes)} classes "
        "too rare for models of their own; try more data (run.episodes) or a smaller learner.smallest_class_segments."
    )


def _too_few_samples_for_modes(newest: IterationRow, classes: Classes) -> str | None:
    alone = [row for row in classes if not row["pooled"]]
    if not alone or newest["modes"] > MODES:
        return None
    rows_per_step = sum(row["rows"] for row in alone) / sum(row["time_steps"] for row in alone)
    if rows_per_step >= ROWS_PER_STEP:
        return None
    return (
        f"There is too little data for several modes: {newest['modes']:.2f} models per class and time step, from "
        f"{rows_per_step:.0f} samples; try more data (run.episodes) or a smaller learner.residual_threshold, "
        "unless learner.modes = 1 is meant."
    )
