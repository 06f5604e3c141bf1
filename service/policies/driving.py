"""The simulator driven by a policy's file alone: the world that it was trained in, and episodes in it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.policies.description import Description
from t6gps.service.policies.driver import START, Driver, measured
from t6gps.service.training import evaluation
from t6gps.service.training.evaluation import Evaluation, Judged
from t6gps.service.training.session import EVALUATION_SECTIONS
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode
from t6gps.workers.episode.rollout import Controller
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.robot.symmetry import CABLES_FROM
from t6gps.workers.worker import RolloutWorker

INSIDE = ("robot.shortest_command_m", "robot.longest_command_m")
"""Settings that are in the file's function, so that another world cannot change them."""


def world(description: Description, overrides: Sequence[str], file: Path) -> Config:
    """The world that a policy was trained in, with changes by `overrides`.

    ConfigError for settings that this simulator does not know or allow, for changes of the policy itself, where the
    ground was a file and none is given, and for errors of sensors, which act inside the file's function.
    """
    configuration.check_keys(overrides, "policy run", EVALUATION_SECTIONS, "the policy is trained already")
    keys = {override.partition("=")[0].strip() for override in overrides}
    if description.ground is not None and "terrain.file" not in keys:
        raise ConfigError(
            f"{file} was trained on the ground of {description.ground.name} (SHA-256 {description.ground.sha256}), "
            "which it does not hold; give that file, or other ground, with --set terrain.file=FILE"
        )
    text = json.dumps({**description.settings, "run": {"steps": description.steps}})
    own, config = configuration.parse(text, (), str(file)), configuration.parse(text, overrides, str(file))
    for key in INSIDE:
        name = key.partition(".")[2]
        inside, asked = getattr(own.robot, name), getattr(config.robot, name)
        if inside != asked:
            raise ConfigError(
                f"{file} commands by {key} = {inside}, the simulator would by {asked}; leave {key} as it is"
            )
    for name in ("sensor_noise", "sensor_bias"):
        value = getattr(config.randomisation, name)
        if value:
            raise ConfigError(
                f"randomisation.{name} = {value} errs in readings that {file} computes for itself; drive it without: "
                f"--set randomisation.{name}=0.0"
            )
    return config


def control(driver: Driver) -> Controller:
    """The controller of the simulator that a policy's file makes, with a state that begins anew with each episode."""
    state = START

    def command(episode: RunningEpisode, step: int) -> NDArray[np.float64]:
        nonlocal state
        before = START if step == 0 else state
        commands, state = driver.decide(measured(episode.state, episode.waypoint), before)
        return commands[CABLES_FROM[episode.frame.element]]

    return command


def drive(
    driver: Driver,
    config: Config,
    episodes: int,
    seed: int,
    terrain_seed: int | None,
    keep: Callable[[Episode], object],
    progress: Callable[[int, int], object],
) -> Evaluation:
    """Noise-free episodes driven by a policy's file, those of `t6gps eval` with the same seeds; each goes to `keep`."""
    described, found = driver.description, list[Judged]()
    plans = seeding.evaluation_plans(config, episodes, seed, terrain_seed, described.policy_version)
    worker = RolloutWorker(config.rollout)
    try:
        for plan in plans:
            episode = worker.drive(plan, control(driver), described.policy_version, described.offset_m)
            found.append(evaluation.judged(episode, config))
            keep(episode)
            progress(len(found), episodes)
    finally:
        worker.close()
    return evaluation.summarise(found, seed)
