"""One episode, as a loop without side effects: plan and policy in, tables out (paper Alg. 2, RunSamples)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.storage.errors import PhysicsError, UnsoundStateError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.episode import exploration, policy
from t6gps.workers.episode.recording import Outcome, Record, to_episode
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.engine import Engine, reach_m
from t6gps.workers.physics.observer import steer
from t6gps.workers.settings import RolloutSettings


def rollout(
    engine: Engine,
    settings: RolloutSettings,
    plan: EpisodePlan,
    snapshot: PolicySnapshot,
    delay_steps: int = 0,
    record: Record | None = None,
) -> Episode:
    """Run the episode that `plan` describes with the policy `snapshot` plus exploration noise.

    The result depends on the arguments alone, whatever the engine did before. An episode that leaves the ground
    or the range of sound states ends there and says why in `ended_by`; PhysicsError if it does so at once. An empty
    `record` of the caller's is filled as the episode goes: it shows how far one came that failed.
    """

    act = policy.ready(snapshot)

    def control(episode: RunningEpisode, _: int) -> NDArray[np.float64]:
        return act(episode.observation)

    return controlled(engine, settings, plan, control, snapshot.version, snapshot.offset_m, delay_steps, record)


Controller = Callable[[RunningEpisode, int], NDArray[np.float64]]
"""Canonical rest lengths [24] (m) to command in an episode at a step, before exploration noise."""


def controlled(
    engine: Engine,
    settings: RolloutSettings,
    plan: EpisodePlan,
    control: Controller,
    version: int,
    nominal_m: float,
    delay_steps: int = 0,
    record: Record | None = None,
) -> Episode:
    """Run the episode that `plan` describes under any controller; `rollout` says the rest.

    `version` goes into the tables as the policy's, observed rest lengths are centred on `nominal_m`.
    """
    episode = RunningEpisode(
        engine, settings, plan.seed, plan.terrain_seed, plan.terrain_difficulty, nominal_m, delay_steps, plan.index
    )
    correlation = 0.0 if plan.within_reach else settings.exploration.noise_correlation
    noise = exploration.noise(episode.noise_rng, plan.noise_std_m, correlation, plan.steps)
    reach = reach_m(settings.robot)
    shortest_m, longest_m = settings.robot.shortest_command_m, settings.robot.longest_command_m

    record = Record() if record is None else record
    _keep(record, episode)
    ended_by = "completed"
    for step, departure in enumerate(noise):
        wanted = control(episode, step)
        if plan.within_reach:
            wanted = schema.reached(wanted, episode.observation, nominal_m, reach)
        mean, command, action = steer(wanted, departure, episode.frame.element, shortest_m, longest_m)
        try:
            episode.advance(command)
        except UnsoundStateError as error:
            if not record.actions:
                raise PhysicsError(f"episode {plan.episode_id}, seed {plan.seed}, step 0: {error}") from error
            # The unsound state is not recorded, so the action that led to it is not either.
            ended_by = error.reason
            break
        record.means.append(mean)
        record.actions.append(action)
        _keep(record, episode)
    outcome = Outcome(
        policy_version=version,
        ended_by=ended_by,
        waypoints_reached=episode.course.reached,
        delay_steps=delay_steps,
    )
    return to_episode(record, plan, outcome, settings, episode.ground)


def _keep(record: Record, episode: RunningEpisode) -> None:
    record.states.append(episode.state)
    record.frames.append(episode.frame)
    record.yaws_rad.append(episode.yaw_rad)
    record.waypoints.append((episode.course.active, *episode.waypoint))
    record.observations.append(episode.observation)
