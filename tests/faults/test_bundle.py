"""Laws of episodes that fail: the run continues without them and says so, and each can be run alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import t6gps
from tiny_run import Watcher

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.pool import crash_bundle
from t6gps.service.training import loop
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import PhysicsError, RunError
from t6gps.workers.episode.start import SETTLE_STEPS
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.state import Array, RobotState

pytestmark = pytest.mark.slow

FAILING, STEP = 1, 7
CONFIG = {
    "run": {"episodes": 3, "steps": 30, "iterations": 1},
    "learner": {"smallest_class_segments": 4, "epochs": 2, "hidden_layers": (16,)},
}


class Tripping(PyBulletEngine):
    """Fails in the failing episode's step STEP, whenever that is run."""

    armed = False

    def set_ground(self, terrain: Any) -> None:
        super().set_ground(terrain)
        self.steps_n = 0

    def control_step(self, command: Array) -> RobotState:
        self.steps_n += 1
        if Tripping.armed and self.steps_n == SETTLE_STEPS + STEP + 1:
            raise PhysicsError("the robot tripped")
        return super().control_step(command)


class Executor(SerialExecutor):
    """Trips in failing episodes."""

    def __init__(self, config: Config, run: Run, failing: set[int]) -> None:
        super().__init__(config, run, Tripping)
        worker_run = self._worker.run

        def tripping(plan: Any, snapshot: Any) -> Any:
            Tripping.armed = plan.episode_id in failing
            return worker_run(plan, snapshot)

        self._worker.run = tripping  # type: ignore[method-assign]


class Stops(Watcher):
    """Stops the run in the last phase of its learner."""

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if phase == "supervise":
            raise KeyboardInterrupt


@pytest.fixture
def run(tmp_path: Path) -> Run:
    config = Config.model_validate(CONFIG)
    return catalog.create(tmp_path, "tripped", config.to_json())


def trained(run: Run, failing: set[int], watcher: Watcher | None = None) -> None:
    executor = Executor(Config.model_validate(CONFIG), run, failing)
    try:
        loop.train(executor.config, run, executor, watcher or Watcher())
    finally:
        executor.close()


def test_t3_a_run_goes_on_without_a_failing_episode_and_keeps_its_last_states(run: Run) -> None:
    trained(run, {FAILING})
    assert tables.read(run, "episodes")["episode_id"].to_pylist() == [0, 2]
    assert tables.read(run, "iterations").select(["episodes", "left_out"]).to_pylist() == [
        {"episodes": 2, "left_out": 1}
    ]
    latest = checkpoint.load_latest(run.checkpoints)
    assert latest is not None
    ledger: Any = latest[1]["ledger"]
    assert ledger["counters"]["quarantined"] == 1
    assert ledger["counters"]["committed"] == 2
    path = run.bundles / f"episode-{FAILING}.json"
    kept = crash_bundle.read(path)
    assert kept.plan == seeding.training_plans(Config.model_validate(CONFIG), 0)[FAILING]
    assert len(kept.failures) == 3
    for failure in kept.failures:
        assert (failure["error"], failure["step"], failure["seed"]) == ("PhysicsError", STEP, kept.plan.seed)
        assert "the robot tripped" in failure["trace"]
        assert [np.shape(state["bar_positions"]) for state in failure["states"]] == [(6, 3)] * 5
    again = json.loads(t6gps("replay", path, "--json").stdout)
    assert (again["now"], again["steps"], again["ended_by"]) == ("succeeded", 30, "completed")


def test_a_failing_episode_is_not_tried_again_until_its_bundle_is_removed(run: Run) -> None:
    with pytest.raises(KeyboardInterrupt):
        trained(run, {FAILING}, Stops())
    bundle = run.bundles / f"episode-{FAILING}.json"
    written_ns = bundle.stat().st_mtime_ns
    with pytest.raises(KeyboardInterrupt):
        trained(run, {FAILING}, Stops())
    assert bundle.stat().st_mtime_ns == written_ns
    bundle.unlink()
    trained(run, set())
    assert tables.read(run, "episodes")["episode_id"].to_pylist() == [0, 1, 2]


def test_a_run_in_which_every_episode_fails_ends_with_one_sentence(run: Run) -> None:
    with pytest.raises(RunError, match=r"nothing but failures comes back; the last: episode 2: PhysicsError.*tripped"):
        trained(run, {0, 1, 2})
    with pytest.raises(RunError, match="every episode of iteration 0 is quarantined"):
        trained(run, set())


def test_what_is_not_a_bundle_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    other.write_text("{}")
    for path in (tmp_path / "none.json", other):
        assert "is not a crash bundle" in t6gps("replay", path, code=2).stderr
