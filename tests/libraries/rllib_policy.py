"""What RLlib needs to be told to act with a policy of T6-GPS in the environment of the benchmark."""

from __future__ import annotations

from typing import Any

import torch
from planned_environment import Actor, PlannedEnvironment
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule

from t6gps.service.bench.contenders import Job

FRAGMENTS_UNDER_WAY_N = 2


class ActorModule(TorchRLModule):
    """A module that learns nothing and acts like the job's policy."""

    def setup(self) -> None:
        settings: Any = self.model_config
        self._actor = Actor(settings["job"])

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        return {Columns.ACTIONS: torch.from_numpy(self._actor(batch[Columns.OBS].numpy()))}


def runner_settings(job: Job) -> PPOConfig:
    """One environment per runner, one runner per process of the job."""
    return (
        PPOConfig()  # type: ignore[no-untyped-call]
        .environment(lambda context: PlannedEnvironment(job, context.worker_index - 1), normalize_actions=False)
        .env_runners(
            num_env_runners=job.workers,
            rollout_fragment_length=job.steps,
            max_requests_in_flight_per_env_runner=FRAGMENTS_UNDER_WAY_N,
        )
        .fault_tolerance(restart_failed_env_runners=False)
        .rl_module(rl_module_spec=RLModuleSpec(module_class=ActorModule, model_config={"job": job}))
    )
