"""A model of stable-baselines3 on its way from mark to mark."""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from t6gps.service.config import Config
from t6gps.service.studies.rivals.port import Trained
from t6gps.service.studies.rivals.senses import Actions, Array, command, senses
from t6gps.service.studies.watcher import Progress
from t6gps.workers.episode.running import RunningEpisode


def along(
    model: BaseAlgorithm, actions: Actions, config: Config, marks: Sequence[int], progress: Progress
) -> Generator[Trained]:
    """Let a model learn as `port.Train` says; its episodes go on across marks."""

    def follow(_: object, __: object) -> bool:
        progress(min(model.num_timesteps, marks[-1]), marks[-1])
        return True

    def control(episode: RunningEpisode, _: int) -> Array:
        action, _state = model.predict(senses(episode), deterministic=True)
        return command(actions, action.astype(np.float32), episode, config.robot)

    for mark in marks:
        model.learn(mark - model.num_timesteps, callback=follow, reset_num_timesteps=False)
        yield Trained(model.num_timesteps, control)
