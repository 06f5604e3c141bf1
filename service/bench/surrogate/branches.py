"""The branch test: recorded pieces once more, with a share of a change added to each recorded action.

    promised    change of cost per step that the models expect of the changed actions
    realised    the same in the simulator: cost of the changed piece minus that of the piece as it was

Both start in the recorded first state; waypoints are those of the recorded rows. The first step of a changed piece is
the one-step response of the dynamics, which Fu is to tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import whole_columns
from t6gps.learner.algorithm.sub_trajectories import sub_trajectories
from t6gps.learner.bench import redone
from t6gps.learner.rows import Floats, Ints
from t6gps.service.bench.surrogate.agreement import Figures, agreement, mean_and_error, named
from t6gps.service.bench.surrogate.stored import Crossing, Stored
from t6gps.storage.errors import DataError, UnsoundStateError
from t6gps.workers.episode import replay
from t6gps.workers.episode.replay import Recorded
from t6gps.workers.episode.task import running_cost
from t6gps.workers.robot.state import RobotState

Array = NDArray[np.float64]
RECORDED = "recorded"
"""The branch without any change."""


@dataclass(frozen=True)
class Branch:
    """Pieces of rows [b, T] in the simulator with a change of their actions [b, T, nu] (m).

    cost    of the state after each step [b, T] (m2/s2); NaN throughout where a state was not sound
    after   what `whole_columns` names of the first state [b, nx]
    """

    change: Floats
    cost: Array
    after: Array


def sampled(stored: Stored, pieces: int, rng: np.random.Generator) -> Ints:
    """Rows [b, T] of so many whole sub-trajectories, or of all. DataError where there are fewer than two."""
    horizon = stored.config.learner.horizon_steps
    starts = sub_trajectories(stored.redone.rows.continues, horizon).get(horizon, np.empty(0, dtype=np.int64))
    if len(starts) < 2:
        raise DataError(
            f"iteration {stored.iteration} has {len(starts)} sub-trajectories of {horizon} steps, at least two "
            "are needed; choose another --iteration, or a run with longer episodes"
        )
    chosen = np.sort(rng.choice(starts, min(pieces, len(starts)), replace=False))
    steps: Ints = chosen[:, None] + np.arange(horizon)
    return steps


def wanted_changes(stored: Stored, steps: Ints) -> dict[str, Floats]:
    """Changes of the actions [b, T, nu]: u* minus the mean by each improver, and what the network took up."""
    mean = stored.redone.rows.action_mean[steps]
    wanted = {"pass": stored.redone.improved.action[steps] - mean}
    if stored.valued is not None:
        wanted["value"] = stored.valued.improved.action[steps] - mean
    wanted["network"] = stored.commands(stored.newest, steps.ravel()).reshape(mean.shape) - mean
    return wanted


def branched(stored: Stored, steps: Ints, wanted: dict[str, Floats]) -> dict[str, Branch]:
    """The pieces with each change, as far as the range of commands allows it."""
    columns = whole_columns(stored.config.learner.reduced_state)
    actions = stored.redone.rows.action[steps]
    commands = {name: (actions + change).clip(*stored.command_range_m) for name, change in wanted.items()}
    branches = {
        name: Branch(
            change=command - actions,
            cost=np.full(steps.shape, np.nan),
            after=np.full((len(steps), list(columns.values())[-1].stop), np.nan),
        )
        for name, command in commands.items()
    }

    def at(crossing: Crossing) -> None:
        place, first, episode, engine, back = crossing
        for name, branch in branches.items():
            back()
            try:
                states = replay.commanded(engine, episode, first, commands[name][place].astype(np.float64))
            except UnsoundStateError:
                continue  # the piece is counted among those that are left out
            branch.cost[place] = _costs(stored, episode, first, states)
            parts = replay.canonical(_first(states), int(episode.face[first + 1]), int(episode.element[first + 1]))
            branch.after[place] = np.concatenate([parts[column] for column in columns])

    stored.visit(steps[:, 0], at)
    return branches


def _first(states: RobotState) -> RobotState:
    return RobotState(states.bars[0], states.rest_lengths[0])


def _costs(stored: Stored, episode: Recorded, first: int, states: RobotState) -> Array:
    """Running cost of the states after row `first` [T], towards the waypoints that their rows have."""
    rows = slice(first + 1, first + 1 + len(states.bars))
    way = episode.waypoint[rows] - states.com[:, :2]
    return running_cost(states.com_velocity, way / np.hypot(*way.T)[:, None], stored.config.task)


def branch_test(stored: Stored, pieces: int, shares: dict[str, float], rng: np.random.Generator) -> Figures:
    """Promised and realised change of cost of each change and each share of it, by the names of the shares.

    The one-step response is that to the whole of u* of the backward pass.
    """
    steps = sampled(stored, pieces, rng)
    wanted = {
        f"{name}{share_name}": share * change
        for name, change in wanted_changes(stored, steps).items()
        for share_name, share in shares.items()
    }
    branches = branched(stored, steps, {RECORDED: np.zeros_like(wanted["pass"])} | wanted)
    still = branches.pop(RECORDED)
    recorded = np.concatenate([episode.frames.column("cost").to_numpy() for episode in stored.episodes])[steps + 1]
    judged = {name: _judged(stored, steps, still, branch) for name, branch in branches.items()}
    figures: Figures = {
        "pieces": float(len(steps)),
        "piece_steps": float(steps.shape[1]),
        "replay_median_cost_difference": float(np.nanmedian(np.abs(still.cost - recorded))),
        "replay_largest_cost_difference": float(np.nanmax(np.abs(still.cost - recorded))),
    }
    for name, found in judged.items():
        figures |= named(f"branch_{name}", found)
    return figures | _response(stored, steps[:, 0], still, branches["pass"], rng)


def _judged(stored: Stored, steps: Ints, still: Branch, branch: Branch) -> dict[str, float]:
    """Means over pieces, with standard errors, of the change of cost per step (m2/s2)."""
    sound = np.isfinite((branch.cost - still.cost).sum(axis=1))
    if sound.sum() < 2:
        raise DataError(
            f"{sound.sum()} of {len(steps)} pieces of iteration {stored.iteration} go here as recorded, two at "
            "least are needed; judge the run with the t6gps that made it"
        )
    promised = redone.promised(stored.redone.surrogate, steps[sound], branch.change[sound]).mean(axis=1)
    realised = (branch.cost - still.cost)[sound].mean(axis=1)
    (expected, expected_error), (found, found_error) = mean_and_error(promised), mean_and_error(realised)
    return {
        "rms_change_m": float(np.sqrt(np.square(branch.change).mean())),
        "promised": expected,
        "promised_standard_error": expected_error,
        "realised": found,
        "realised_standard_error": found_error,
        "ratio": found / expected,
        "left_out": float((~sound).sum()),
    }


def _response(stored: Stored, rows: Ints, still: Branch, branch: Branch, rng: np.random.Generator) -> Figures:
    """How the next reduced state answers to the change of the first action, and how Fu says that it does."""
    change = branch.after - still.after
    sound = np.isfinite(change).all(axis=1)
    expected = redone.response(stored.redone.surrogate, rows[sound], branch.change[sound, 0])
    figures: Figures = {}
    for column, place in whole_columns(stored.config.learner.reduced_state).items():
        promised, realised = expected[:, place], change[sound][:, place]
        episode = np.repeat(stored.episode[rows[sound]], promised.shape[1])
        figures |= named(f"response_{column}", agreement(promised.ravel(), realised.ravel(), episode, rng))
    return figures
