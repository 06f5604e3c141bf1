"""PPO, from stable-baselines3."""

from __future__ import annotations

from collections.abc import Generator, Sequence

import torch
from stable_baselines3 import PPO

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.seeding import Branch
from t6gps.service.studies.rivals import learning, settings
from t6gps.service.studies.rivals.environment import RivalEnvironment
from t6gps.service.studies.rivals.port import Trained
from t6gps.service.studies.rivals.senses import Actions
from t6gps.service.studies.watcher import Progress


def train(actions: Actions, config: Config, marks: Sequence[int], progress: Progress) -> Generator[Trained]:
    """Learn as `port.Train` says, with these actions."""
    torch.set_num_threads(1)
    chosen = settings.PPO
    with RivalEnvironment(config, actions) as environment:
        model = PPO(
            "MlpPolicy",
            environment,
            learning_rate=chosen.learning_rate,
            n_steps=chosen.rollout,
            batch_size=chosen.batch,
            gamma=chosen.discount,
            policy_kwargs={
                "net_arch": list(chosen.layers),
                "activation_fn": torch.nn.Tanh,
                "log_std_init": chosen.first_log_deviation,
            },
            seed=seeding.number(config.run.seed, Branch.RIVALS, 0),
            device="cpu",
        )
        yield from learning.along(model, actions, config, marks, progress)
