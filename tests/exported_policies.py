"""A policy with any weights, an episode that it has driven, and its file in every format."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from t6gps.service import seeding
from t6gps.service.config import Config, RunSettings
from t6gps.service.policies import files
from t6gps.service.policies.driver import Driver
from t6gps.service.policies.files import Format
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.worker import RolloutWorker

STEPS = 40


@dataclass(frozen=True)
class Material:
    """A policy, an episode that it has driven in the simulator, and its files, opened."""

    config: Config
    snapshot: PolicySnapshot
    plan: EpisodePlan
    episode: Episode
    files: dict[Format, Path]
    drivers: dict[Format, Driver]


def snapshot(widths: list[int], offset_m: float) -> PolicySnapshot:
    """A policy of version 3 that moves every cable by some 0.3 m."""
    rng = np.random.default_rng(widths)
    layers = tuple(
        (
            (rng.standard_normal((n_out, n_in)) / np.sqrt(n_in)).astype(np.float32),
            rng.standard_normal(n_out).astype(np.float32),
        )
        for n_in, n_out in pairwise(widths)
    )
    return PolicySnapshot(3, layers, offset_m, 0.2)


def material(widths: list[int], folder: Path) -> Material:
    """The policy of layers of such widths, its files in a folder."""
    config = Config(run=RunSettings(steps=STEPS))
    policy = snapshot(widths, nominal_rest_length(config.robot))
    plan = seeding.evaluation_plans(config, 1, 5, None, policy.version)[0]
    worker = RolloutWorker(config.rollout)
    episode = worker.run(plan, policy)
    worker.close()
    written = {
        form: files.write(form, folder / f"policy{kind.suffix}", "rolling", config, None, policy)
        for form, kind in files.FORMS.items()
    }
    opened = {form: files.opened(file) for form, file in written.items()}
    return Material(config, policy, plan, episode, written, opened)
