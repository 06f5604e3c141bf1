"""A real episode on rough ground, as the tests of pictures and of the page show it."""

from __future__ import annotations

import numpy as np

from t6gps.storage import schema
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker

PLAN = EpisodePlan(
    episode_id=7,
    iteration=0,
    index=7,
    seed=123,
    steps=60,
    terrain_seed=5,
    terrain_difficulty=0.7,
    noise_std_m=0.15,
    policy_version=0,
)


def walked(settings: RolloutSettings) -> Episode:
    """The episode PLAN of an untrained policy in the world of these settings."""
    layer = (np.zeros((CABLES_N, schema.OBSERVATION_N), np.float32), np.zeros(CABLES_N, np.float32))
    worker = RolloutWorker(settings)
    try:
        return worker.run(PLAN, PolicySnapshot(0, (layer,), nominal_rest_length(settings.robot), 0.2))
    finally:
        worker.close()
