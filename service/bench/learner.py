"""Speed of the learner at the paper's size: 300 episodes of 250 steps on rough ground, sampled for the purpose."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from functools import partial

import pyarrow as pa

from t6gps.learner.bench import growth as replicas
from t6gps.learner.bench import speed
from t6gps.learner.phases import PHASES
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.wiring import new_learner
from t6gps.service.views import terminal
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot

UNTRAINED_EPISODES = 60
THREADS = os.cpu_count()
"""Of the backward pass; the S-step has two, everything else one."""


def learner() -> dict[str, float]:
    """What `learner.bench.speed` finds for the second iteration of the preset `rough`.

    The robot is simulated for it, which takes one to two minutes on two cores and is not part of any figure.
    """
    config = configuration.load("rough", ["run.episodes=300"])
    return speed.measure(lambda: new_learner(config), _rolling(config), config.learner)


def growth() -> dict[str, float]:
    """What `learner.bench.growth` finds for the same episodes, once, four and sixteen times; a quarter of an hour.

    The action value leads from the second iteration on and remembers three; the pairs of one are replayed.
    """
    settings = ["run.episodes=300", "learner.value_from=1", "learner.replay_iterations=1"]
    config = configuration.load("rough", settings)
    return replicas.measure(partial(new_learner, config), _rolling(config))


def _rolling(config: Config) -> list[pa.Table]:
    """300 episodes on rough ground of a robot that rolls, as in all but the first iteration.

    They follow 60 episodes of the untrained policy and one iteration of learning from them.
    """
    taught = new_learner(config)
    untrained, trained = seeding.training_plans(config, 0)[:UNTRAINED_EPISODES], seeding.training_plans(config, 1)
    with closing(RayExecutor(config)) as executor:
        for frames in _sampled(executor, untrained, taught.policy()):
            taught.add(frames)
        for phase in PHASES:
            for _ in getattr(taught, phase.name)():
                pass
        return _sampled(executor, trained, taught.policy())


def _sampled(executor: Executor, plans: Sequence[EpisodePlan], policy: PolicySnapshot) -> list[pa.Table]:
    """Frames of the episodes, in the order of their plans."""
    found: dict[int, pa.Table] = {}
    with terminal.task(f"sampling {len(plans)} episodes") as progress:

        def keep(episode: Episode) -> None:
            found[episode.summary["index"][0].as_py()] = episode.frames
            progress(len(found), len(plans))

        executor.sample(plans, policy, keep)
    return [found[index] for index in sorted(found)]
