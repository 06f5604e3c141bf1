"""Contenders of other libraries. Both step and observe the episodes of a job; neither records nor keeps them.

async_vector_env   Gymnasium's AsyncVectorEnv: this process acts for all environments, which step together
rllib              RLlib's EnvRunnerGroup: each runner acts and sends back fragments as long as an episode, two of
                   them under way; the policy is that of all the others, in place of a torch network
"""

from __future__ import annotations

from functools import partial
from typing import Any

from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from planned_environment import Actor, PlannedEnvironment
from ray.rllib.env.env_runner_group import EnvRunnerGroup
from rllib_policy import runner_settings

from t6gps.service.bench.contenders import Job
from t6gps.service.bench.tally import Tally
from t6gps.service.ray_backend.cluster import connection


def async_vector_env(job: Job) -> Tally:
    """Gymnasium's AsyncVectorEnv with one environment per process."""
    makers = [partial(PlannedEnvironment, job, first) for first in range(job.workers)]
    environments = AsyncVectorEnv(makers, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
    tally, act = Tally(job.seconds), Actor(job)
    try:
        observations, _ = environments.reset()
        while not tally.add(job.workers):
            observations = environments.step(act(observations))[0]
    finally:
        environments.close()
    return tally


def rllib(job: Job) -> Tally:
    """RLlib's EnvRunnerGroup, asked as IMPALA asks it."""
    with connection(job.config):
        runners = EnvRunnerGroup(config=runner_settings(job), local_env_runner=False)
        tally = Tally(job.seconds)
        while not tally.is_over:
            ready: list[Any] = runners.foreach_env_runner_async_fetch_ready(
                func="sample", tag="sample", timeout_seconds=1.0
            )
            for episodes in ready:
                tally.add(sum(len(episode) for episode in episodes))
        return tally
