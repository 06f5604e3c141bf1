"""The learner at the paper's size, 300 episodes of 250 steps on rough ground, and what grows when there are more."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing

from t6gps.learner.bench import speed
from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench import growth
from t6gps.service.bench.rounds import Say
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.wiring import new_learner
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

UNTRAINED_EPISODES = 60
THREADS = os.cpu_count()
"""Of the backward pass; everything else has one."""
NOTES = (growth.NOTE,)


def learner(say: Say) -> dict[str, float]:
    """What `learner.bench.speed` finds for the second iteration of the preset `rough`, and `growth` for more episodes.

    The robot is simulated for it, which takes one to two minutes on two cores and is not part of any figure.
    """
    config = configuration.load("rough", ["run.episodes=300"])
    episodes = _rolling(config, say)
    say(f"speed: {len(episodes)} episodes")
    figures = speed.measure(lambda: new_learner(config), [episode.frames for episode in episodes], config.learner)
    return figures | growth.growth(episodes, say)


def _rolling(config: Config, say: Say) -> list[Episode]:
    """300 episodes on rough ground of a robot that rolls, as in all but the first iteration.

    They follow 60 episodes of the untrained policy and one iteration of learning from them.
    """
    taught = new_learner(config)
    untrained, trained = seeding.training_plans(config, 0)[:UNTRAINED_EPISODES], seeding.training_plans(config, 1)
    with closing(RayExecutor(config)) as executor:
        say(f"sampling {len(untrained)} and {len(trained)} episodes")
        for episode in _sampled(executor, untrained, taught.policy()):
            taught.add(episode.frames, episode.noise_std_m)
        for phase in PHASES:
            for _ in getattr(taught, phase.name)():
                pass
        return _sampled(executor, trained, taught.policy())


def _sampled(executor: Executor, plans: Sequence[EpisodePlan], policy: PolicySnapshot) -> list[Episode]:
    """Episodes in the order of their plans."""
    sampled: list[Episode] = []
    executor.sample(plans, policy, sampled.append)
    return sorted(sampled, key=lambda episode: episode.episode_id)
