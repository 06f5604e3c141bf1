"""Laws of crash bundles: they go where their run goes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from t6gps.service.pool import crash_bundle
from t6gps.storage import catalog
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings, TerrainSettings


def test_a_bundle_of_a_run_that_was_moved_stands_on_the_ground_that_the_run_keeps(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "{}", {"ground/hills.npy": b"hills"})
    settings = RolloutSettings(terrain=TerrainSettings(file=str(run.ground / "hills.npy")))
    policy = PolicySnapshot(0, ((np.zeros((2, 3), np.float32), np.zeros(2, np.float32)),), 1.0, 0.2)
    plan = EpisodePlan(7, 0, 7, 1, 10, 1, 0.0, 0.1, 0)
    name = crash_bundle.write(run.bundles, "episode", plan, settings, policy, []).name
    moved = catalog.move(run, tmp_path, "two")
    assert crash_bundle.read(moved.bundles / name).settings.terrain.file == str(moved.ground / "hills.npy")
