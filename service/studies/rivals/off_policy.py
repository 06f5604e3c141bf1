"""SAC, TQC and CrossQ, from stable-baselines3 and sb3-contrib."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from enum import StrEnum

import torch
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.seeding import Branch
from t6gps.service.studies.rivals import learning, settings
from t6gps.service.studies.rivals.environment import RivalEnvironment
from t6gps.service.studies.rivals.headings import HeadingBuffer
from t6gps.service.studies.rivals.port import Trained
from t6gps.service.studies.rivals.senses import Actions
from t6gps.service.studies.watcher import Progress


class Algorithm(StrEnum):
    """Ways of learning from a memory of transitions."""

    SAC = "sac"
    TQC = "tqc"
    CROSSQ = "crossq"


LIBRARY = {Algorithm.SAC: SAC, Algorithm.TQC: TQC, Algorithm.CROSSQ: CrossQ}
SETTINGS = {Algorithm.SAC: settings.SAC, Algorithm.TQC: settings.TQC, Algorithm.CROSSQ: settings.CROSSQ}


def train(
    algorithm: Algorithm, actions: Actions, config: Config, marks: Sequence[int], progress: Progress
) -> Generator[Trained]:
    """Learn as `port.Train` says, with these actions."""
    torch.set_num_threads(1)
    chosen, seed = SETTINGS[algorithm], config.run.seed
    with RivalEnvironment(config, actions) as environment:
        model = LIBRARY[algorithm](
            "MlpPolicy",
            environment,
            learning_rate=chosen.learning_rate,
            buffer_size=marks[-1],
            learning_starts=chosen.first_steps,
            batch_size=chosen.batch,
            gamma=chosen.discount,
            train_freq=chosen.steps_per_update,
            gradient_steps=1,
            replay_buffer_class=HeadingBuffer,
            replay_buffer_kwargs={"task": config.task, "rng": seeding.generator(seed, Branch.RIVALS, 1)},
            ent_coef=f"auto_{chosen.first_entropy_weight}",
            policy_kwargs={"net_arch": {"pi": list(chosen.actor), "qf": list(chosen.critics)}},
            seed=seeding.number(seed, Branch.RIVALS, 0),
            device="cpu",
        )
        yield from learning.along(model, actions, config, marks, progress)
