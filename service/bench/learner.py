"""Speed of the learner at the paper's size: 300 episodes of 250 steps on rough ground, sampled for the purpose."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing

import pyarrow as pa

from t6gps.learner.bench import speed as benchmarks
from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.execution.executor import PHASES, Executor
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.serial import new_learner
from t6gps.service.views import terminal
from t6gps.storage.records import EpisodePlan, PolicySnapshot

UNTRAINED_EPISODES = 60
THREADS = os.cpu_count()
"""Of the backward pass; the S-step has two, everything else one."""


def learner() -> dict[str, float]:
    """What `learner.benchmarks.measure` finds for the second iteration of the preset `rough`.

    The robot is simulated for it, on the preset's workers: 60 episodes of the untrained policy, one iteration of
    learning from them, then the 300 episodes that are measured - a robot that rolls, as in all but the first
    iteration. That takes one to two minutes on two cores and is not part of any figure.
    """
    config = configuration.load("rough", ["run.episodes=300"])
    policy = new_learner(config)
    untrained, trained = seeding.training_plans(config, 0)[:UNTRAINED_EPISODES], seeding.training_plans(config, 1)
    with closing(RayExecutor(config)) as executor:
        for frames in _sampled(executor, untrained, policy.policy()):
            policy.add(frames)
        for phase in PHASES:
            for _ in getattr(policy, phase)():
                pass
        episodes = _sampled(executor, trained, policy.policy())
    return benchmarks.measure(lambda: new_learner(config), episodes, config.learner)


def _sampled(executor: Executor, plans: Sequence[EpisodePlan], policy: PolicySnapshot) -> list[pa.Table]:
    """Frames of the episodes, in the order of their plans."""
    found = {}
    with terminal.task(f"sampling {len(plans)} episodes") as progress:
        for episode in executor.sample(plans, policy):
            found[episode.summary["index"][0].as_py()] = episode.frames
            progress(len(found), len(plans))
    return [found[index] for index in sorted(found)]
