"""A committed iteration of a run, learned from again: its episodes, policies, improved actions and models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import Canonical
from t6gps.learner.bench import redone
from t6gps.learner.bench.redone import Redone, Valued
from t6gps.learner.episodes import Episodes
from t6gps.learner.improvers import transitions
from t6gps.learner.rows import Floats, Ints
from t6gps.learner.settings import Localization
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench.rounds import Say
from t6gps.service.config import Config
from t6gps.service.execution.wiring import new_learner
from t6gps.service.training import origin, policies
from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.episode import policy, replay
from t6gps.workers.episode.replay import Recorded
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.robot.symmetry import PROPER

SAME = 1e-3
"""Relative difference of the promised change above which an iteration was not learned from alike."""


class Crossing(NamedTuple):
    """Where branches leave an episode: place of the row among those visited, its step, and a simulator in that row.

    back   brings the simulator back to the row, before the next branch
    """

    place: int
    step: int
    episode: Recorded
    engine: PyBulletEngine
    back: Callable[[], None]


Branching = Callable[[Crossing], None]


@dataclass(frozen=True)
class Stored:
    """An iteration of a run.

    plans            of the episodes
    acted            policies that acted in the episodes, by version
    acting, newest   policies: the newest before the iteration, and the one that it has led to
    redone           what the learner makes of its episodes, improved by the backward pass
    valued           the same by the action value, None for a run without one
    episode, first   episode of each row, and first row of each episode, counted from 0
    led_by_value     the newest policy was trained on actions of the action value
    """

    config: Config
    iteration: int
    episodes: list[Episode]
    plans: list[EpisodePlan]
    acted: dict[int, PolicySnapshot]
    acting: PolicySnapshot
    newest: PolicySnapshot
    redone: Redone
    valued: Valued | None
    episode: Ints
    first: Ints
    led_by_value: bool

    @property
    def command_range_m(self) -> tuple[float, float]:
        """Shortest and longest command."""
        return self.config.robot.shortest_command_m, self.config.robot.longest_command_m

    @property
    def reach_m(self) -> float:
        """Farthest that a winch comes in a control step, as the learner has it."""
        return self.config.robot.winch_speed_m_per_s * CONTROL_STEP_S

    def commands(self, snapshot: PolicySnapshot, rows: Ints) -> Floats:
        """What a policy commands without noise in rows [m], within the range of commands [m, nu] (m)."""
        act, observation = policy.ready(snapshot), self.redone.rows.observation
        return np.stack([act(observation[row]) for row in rows]).clip(*self.command_range_m).astype(np.float32)

    def visit(self, rows: Ints, branch: Branching) -> None:
        """Run the episodes of some rows [m] again, and branch off in these."""
        of = self.episode[rows]
        numbers = np.unique(of).tolist()
        recorded = (
            replay.recorded(self.episodes[number], self.plans[number], self.config.rollout) for number in numbers
        )
        for number, (episode, engine) in zip(numbers, replay.staged(recorded), strict=True):
            places = {int(rows[place] - self.first[number]): place for place in np.flatnonzero(of == number).tolist()}
            at = partial(_at, branch, places, episode, engine)
            replay.revisited(engine, episode, self.acted[_version(self.episodes[number])], places, at)


def _at(
    branch: Branching,
    places: dict[int, int],
    episode: Recorded,
    engine: PyBulletEngine,
    row: int,
    back: Callable[[], None],
) -> None:
    branch(Crossing(places[row], row, episode, engine, back))


def load(run: Run, iteration: int | None, say: Say, overrides: Sequence[str] = ()) -> Stored:
    """Learn from an iteration again, by default from the last one that the backward pass led.

    `overrides` are settings of the learner other than the run's; what the network took up is of the run all the same.

    RunError for an iteration that is not committed, whose policies are not kept, or whose run is of a later version;
    ConfigError for a run whose models are in world axes.
    """
    configuration.check_keys(overrides, "bench surrogate", ("learner.",), "the episodes are sampled already")
    own, config = origin.configured(run), origin.configured(run, overrides)
    networks = [(each.learner.observation, each.learner.hidden_layers) for each in (own, config)]
    if networks[0] != networks[1]:
        raise ConfigError(
            f"bench surrogate cannot change the network of run {run.name}, whose policies are trained already; leave "
            "learner.observation and learner.hidden_layers as they are"
        )
    if config.learner.localization is Localization.TIME:
        raise ConfigError(
            f"run {run.name} has learner.localization = time, found models in world axes; bench surrogate judges "
            "models in canonical frames: choose a run with another localization"
        )
    at = _chosen(run, own, iteration)
    newest, acting = policies.load(run, at + 1), policies.load(run, at)
    changed = origin.changes(run)
    if changed is not None:
        say(f"warning: {changed}")
    episodes = tables.episodes_of(run, at)
    say(f"learning from iteration {at} of run {run.name} again: {len(episodes)} episodes")
    again = _by_backward_pass(config, acting, episodes)
    valued = _by_action_value(run, config, at, again, say) if config.learner.value_from else None
    lengths = np.array([episode.frames.num_rows for episode in episodes])
    stored = Stored(
        config=config,
        iteration=at,
        episodes=episodes,
        acting=acting,
        newest=newest,
        redone=again,
        plans=_plans(config, at, episodes),
        acted={version: policies.load(run, version) for version in sorted(set(map(_version, episodes)))},
        valued=valued,
        episode=np.repeat(np.arange(len(lengths)), lengths),
        first=np.cumsum(lengths) - lengths,
        led_by_value=0 < own.learner.value_from <= at,
    )
    if not overrides:
        _compare(run, stored, say)
    return stored


def _version(episode: Episode) -> int:
    """The policy that acted in an episode."""
    return int(episode.summary.column("policy_version")[0].as_py())


def _plans(config: Config, iteration: int, episodes: list[Episode]) -> list[EpisodePlan]:
    by_id = {plan.episode_id: plan for plan in seeding.training_plans(config, iteration)}
    return [by_id[episode.episode_id] for episode in episodes]


def _chosen(run: Run, config: Config, iteration: int | None) -> int:
    committed = tables.committed_iterations(run)
    if committed == 0:
        raise RunError(f"run {run.name} has no committed iteration; let it finish one")
    if iteration is None:
        return min(committed, config.learner.value_from or committed) - 1
    if iteration >= committed:
        raise RunError(
            f"run {run.name} has no iteration {iteration}; committed: 0 to {committed - 1}; choose one by --iteration"
        )
    return iteration


def _by_backward_pass(config: Config, acting: PolicySnapshot, episodes: list[Episode]) -> Redone:
    learner = config.learner.model_copy(update={"value_from": 0})
    run = config.run.model_copy(update={"pipelined": False})
    alone = config.model_copy(update={"learner": learner, "run": run})
    frames = ((episode.frames, episode.noise_std_m) for episode in episodes)
    weights = config.task.target_speed_m_per_s, config.task.vertical_weight
    return redone.by_backward_pass(new_learner(alone), acting, frames, weights)


def _by_action_value(run: Run, config: Config, at: int, again: Redone, say: Say) -> Valued:
    robot, motion = config.robot, transitions.Motion(~PROPER)
    reach_m = robot.winch_speed_m_per_s * CONTROL_STEP_S

    def transitions_of(iteration: int) -> transitions.Transitions:
        say(f"the action value learns from iteration {iteration}")
        known = Episodes([Canonical(config.learner.reduced_state), motion], config.learner.longest_segment_steps)
        for episode in tables.episodes_of(run, iteration, transitions.COLUMNS):
            known.add(episode.episode_id, episode.frames)
        return transitions.of_columns(known.joined().columns, reach_m)

    return redone.by_action_value(
        again,
        config.learner,
        config.run.seed,
        at,
        (robot.shortest_command_m, robot.longest_command_m),
        lambda version: policies.load(run, version),
        transitions_of,
    )


def _compare(run: Run, stored: Stored, say: Say) -> None:
    """Say so where the iteration was not learned from as the run had learned from it."""
    column = tables.read(run, "iterations", ["iteration", "predicted_cost_change"]).to_pylist()
    then = next(row["predicted_cost_change"] for row in column if row["iteration"] == stored.iteration)
    now = promised_mean(stored)
    if abs(now - then) > SAME * abs(then):
        say(
            f"warning: iteration {stored.iteration} promised {then:.4f} m2/s2 a step when made and {now:.4f} now: "
            "another build or machine learns otherwise; the figures are those of the present one"
        )


def promised_mean(stored: Stored) -> float:
    """What `iterations.predicted_cost_change` is of the actions that led the iteration (m2/s2)."""
    valued = stored.valued if stored.led_by_value else None
    improved = stored.redone.improved if valued is None else valued.improved
    values: NDArray[np.float32] = improved.predicted_cost_change[stored.redone.rows.continues]
    return float(values.mean(dtype=np.float64))
