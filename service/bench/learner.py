"""The learner at the paper's size, 300 episodes of 250 steps on rough ground, and what grows when there are more."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

from t6gps.learner.bench import speed
from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.scaling import growth
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.wiring import new_learner
from t6gps.storage import ipc
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
    with rolling(config, say) as sampled:
        episodes = sampled
    say(f"speed: {len(episodes)} episodes")
    figures = speed.measure(lambda: new_learner(config), [episode.frames for episode in episodes], config.learner)
    return figures | growth.growth(episodes, say)


@contextmanager
def rolling(config: Config, say: Say) -> Iterator[list[Episode]]:
    """An iteration's episodes of a robot that rolls, as in all but the first; their workers are there until the end.

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
        yield _sampled(executor, trained, taught.policy())


def _sampled(executor: Executor, plans: Sequence[EpisodePlan], policy: PolicySnapshot) -> list[Episode]:
    """Episodes in the order of their plans; copies, since the object store's memory goes with its Ray."""
    sampled: list[Episode] = []

    def keep(episode: Episode) -> None:
        sampled.append(Episode(*ipc.unpack(ipc.pack(episode.frames, episode.summary), 2)))

    executor.sample(plans, policy, keep)
    return sorted(sampled, key=lambda episode: episode.episode_id)
