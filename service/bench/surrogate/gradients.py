"""The gradient test: what the first effective action is worth in the closed loop, and what is said to be its worth.

    e     clip((u - rest lengths) / reach, -1, 1) of the noise-free command of the policy that acted
    d     a random sign for each cable;   e+, e- = clip(e +- d, -1, 1), as far as the range of commands allows it
    J     sum over K control steps of gamma^k cost, the policy acting without noise after the first one
    g     an estimate of dJ/de

    realised    J(e+) - J(e-)          promised    g' (e+ - e-)

Recorded states are drawn at random. Unlike the branch test nothing here has seen what happened next. The direction of
the waypoint stays that of the first row, as the action value has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.bench import redone
from t6gps.learner.rows import Floats, Ints
from t6gps.service.bench.surrogate.agreement import Figures, agreement, named
from t6gps.service.bench.surrogate.stored import Crossing, Stored
from t6gps.storage.errors import UnsoundStateError
from t6gps.workers.episode import replay
from t6gps.workers.episode.task import running_cost

Array = NDArray[np.float64]
STEPS = (5, 25)
"""K: the shorter sum has less of what is beyond any prediction, the longer one is nearer to what Q adds up."""


@dataclass(frozen=True)
class Moved:
    """Effective actions [m, nu] that are tried in rows [m]: that of the policy, and one on either side of it.

    rest   canonical rest lengths [m, nu] (m)
    """

    rows: Ints
    rest: Floats
    own: Floats
    plus: Floats
    minus: Floats


def moved(stored: Stored, states: int, rng: np.random.Generator) -> Moved:
    """What is tried in so many recorded states that have a model, or in all of them."""
    index = np.flatnonzero(stored.redone.rows.continues)
    rows = np.sort(rng.choice(index, min(states, len(index)), replace=False))
    rest, (low, high) = _rest_lengths(stored, rows), stored.command_range_m
    own = ((stored.commands(stored.acting, rows) - rest) / stored.reach_m).clip(-1, 1)
    sign = rng.choice(np.array([-1, 1], dtype=np.float32), own.shape)
    plus, minus = (
        ((rest + stored.reach_m * (own + way * sign).clip(-1, 1)).clip(low, high) - rest) / stored.reach_m
        for way in (1, -1)
    )
    return Moved(rows, rest, own, plus, minus)


def _rest_lengths(stored: Stored, rows: Ints) -> Floats:
    """Canonical rest lengths in rows [m, nu] (m)."""
    columns = [np.stack(episode.frames.column("rest_lengths").to_numpy()) for episode in stored.episodes]
    found: Floats = np.concatenate(columns)[rows].astype(np.float32)
    return found


def estimates(stored: Stored, tried: Moved) -> dict[str, NDArray[np.floating]]:
    """dJ/de [m, nu] (m2/s2) by whom it comes from."""
    surrogate = stored.redone.surrogate
    slope = redone.slopes_of_pass(surrogate, stored.config.learner.horizon_steps)[tried.rows]
    found: dict[str, NDArray[np.floating]] = {"pass": slope * stored.reach_m}
    if stored.valued is not None:
        speed = stored.config.task.target_speed_m_per_s
        found["value"] = redone.slopes_of_value(stored.valued, tried.rows, tried.own, speed)
        found["mean"] = (found["pass"] + found["value"]) / 2
    return found


def realised(stored: Stored, tried: Moved) -> Array:
    """Cost of the state after each step when e+ comes first, minus that when e- does [m, K]; NaN if one is unsound."""
    plus, minus = (tried.rest + stored.reach_m * way for way in (tried.plus, tried.minus))
    difference = np.full((len(tried.rows), max(STEPS)), np.nan)

    def at(crossing: Crossing) -> None:
        try:
            ahead, behind = (_costs(stored, crossing, way[crossing.place]) for way in (plus, minus))
        except UnsoundStateError:
            return  # the state is counted among those that are left out
        difference[crossing.place] = ahead - behind

    stored.visit(tried.rows, at)
    return difference


def _costs(stored: Stored, crossing: Crossing, action: Floats) -> Array:
    _, first, episode, engine, back = crossing
    back()
    states = replay.followed(engine, episode, first, action.astype(np.float64), stored.acting, max(STEPS))
    way = episode.waypoint[first] - episode.state.com[first, :2]
    return running_cost(states.com_velocity, way / np.hypot(*way), stored.config.task)


def gradient_test(stored: Stored, states: int, rng: np.random.Generator) -> Figures:
    """Correlation and slope of each estimate, for each K."""
    tried = moved(stored, states, rng)
    difference = realised(stored, tried)
    sound = np.isfinite(difference.sum(axis=1))
    discount = stored.config.learner.action_value.discount ** np.arange(max(STEPS))
    figures: Figures = {"gradient_states": float(len(sound)), "gradient_left_out": float((~sound).sum())}
    for name, slope in estimates(stored, tried).items():
        promised = np.einsum("mu,mu->m", slope, tried.plus - tried.minus)[sound]
        for steps in STEPS:
            worth = difference[sound, :steps] @ discount[:steps]
            found = agreement(promised, worth, stored.episode[tried.rows[sound]], rng)
            figures |= named(f"gradient_{name}_{steps}_steps", found)
    return figures
