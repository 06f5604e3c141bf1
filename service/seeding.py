"""Every random stream of a run hangs on one tree: (run seed, purpose, iteration, episode), never on a worker."""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np

from t6gps.learner import streams
from t6gps.service.config import Config
from t6gps.storage.records import EpisodePlan
from t6gps.workers.physics.engine import reach_m


@unique
class Branch(IntEnum):
    """First spawn key below a run's seed. No number comes twice: equal branches would draw equal numbers.

    TRAINING             seeds of the episodes that are learned from, and of their ground
    LEARNER              the learner, which has streams of its own below it (`learner.streams`)
    EVALUATION           seeds of noise-free episodes, and of their ground
    EVALUATION_TERRAIN   seeds of their ground alone, where it has a seed of its own
    BASELINES            baselines that draw random numbers (`studies.baselines`)
    RIVALS               rivals, and what their libraries draw (`studies.rivals`)
    """

    TRAINING = 0
    LEARNER = streams.LEARNER
    EVALUATION = 2
    EVALUATION_TERRAIN = 3
    BASELINES = 4
    RIVALS = 5


QUIET = 0.2
"""Factor of the noise in quiet episodes."""


def training_plans(config: Config, iteration: int) -> list[EpisodePlan]:
    """Plans of an iteration; they depend on the configuration and the iteration alone.

    The policy is the one that the iteration before has led to; in a pipelined run, whose learner is still at work on
    that, the one before it.
    """
    size = config.run.episodes
    staleness = 1 if config.run.pipelined else 0
    return [
        _plan(
            config,
            seeds=_seeds(config.run.seed, Branch.TRAINING, iteration, index),
            episode_id=iteration * size + index,
            iteration=iteration,
            index=index,
            noise_std_m=_noise_std_m(config, iteration, index),
            version=max(iteration - staleness, 0),
            within_reach=config.learner.explores_within_reach(iteration),
        )
        for index in range(size)
    ]


def _noise_std_m(config: Config, iteration: int, index: int) -> float:
    """Exploration noise of a training episode; quiet ones are spread evenly, and there are none in iteration 0.

    They show where the policy rests when no noise moves it on; the untrained one rests everywhere.
    """
    exploration = config.exploration
    quiet = int((index + 1) * exploration.quiet_share) > int(index * exploration.quiet_share)
    noise_std_m = exploration.noise_std_m
    if config.learner.explores_within_reach(iteration):
        noise_std_m = config.learner.action_value.reach_noise * reach_m(config.robot)
    return noise_std_m * (QUIET if iteration and quiet else 1.0)


def evaluation_plans(
    config: Config, episodes: int, seed: int, terrain_seed: int | None, version: int
) -> list[EpisodePlan]:
    """Noise-free plans on seeds that no training plan uses; the terrain changes with `terrain_seed` if given."""
    plans = []
    for index in range(episodes):
        start, terrain = _seeds(seed, Branch.EVALUATION, index)
        if terrain_seed is not None:
            terrain = _seeds(terrain_seed, Branch.EVALUATION_TERRAIN, index)[1]
        plans.append(_plan(config, (start, terrain), index, version, index, noise_std_m=0.0, version=version))
    return plans


def _plan(
    config: Config,
    seeds: tuple[int, int],
    episode_id: int,
    iteration: int,
    index: int,
    noise_std_m: float,
    version: int,
    within_reach: bool = False,
) -> EpisodePlan:
    return EpisodePlan(
        episode_id=episode_id,
        iteration=iteration,
        index=index,
        seed=seeds[0],
        steps=config.run.steps,
        terrain_seed=seeds[1],
        terrain_difficulty=config.terrain.difficulty,
        noise_std_m=noise_std_m,
        policy_version=version,
        within_reach=within_reach,
    )


def sequence(root: int, branch: Branch, *further: int) -> np.random.SeedSequence:
    """The root of a branch, or of one of its parts, below a seed."""
    return np.random.SeedSequence(root, spawn_key=(int(branch), *further))


def generator(root: int, branch: Branch, *further: int) -> np.random.Generator:
    """A generator of a branch, or of one of its parts, below a seed."""
    return np.random.default_rng(sequence(root, branch, *further))


def number(root: int, branch: Branch, *further: int) -> int:
    """A seed of 32 bits for a library that wants a number, of a branch or of one of its parts, below a seed."""
    return int(sequence(root, branch, *further).generate_state(1)[0])


def _seeds(root: int, branch: Branch, *further: int) -> tuple[int, int]:
    """Two 63-bit seeds: of the episode and of its terrain."""
    first, second = sequence(root, branch, *further).generate_state(2, np.uint64) >> np.uint64(1)
    return int(first), int(second)
