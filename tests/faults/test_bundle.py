"""Laws of episodes that fail: the run goes on without them and says so, and each can be run alone."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from t6gps.service import seeding
from t6gps.service.cli import main
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

POISON, STEP = 1, 7
CONFIG = {
    "run": {"episodes": 3, "steps": 30, "iterations": 1},
    "learner": {"smallest_class_segments": 4, "epochs": 2, "hidden_layers": (16,)},
}


class Tripping(PyBulletEngine):
    """Fails in the poison episode's step STEP, whenever that is run."""

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
    """Trips in episodes that are poison."""

    def __init__(self, config: Config, this: Run, poison: set[int]) -> None:
        super().__init__(config, this, Tripping)
        worker_run = self._worker.run

        def tripping(plan: Any, snapshot: Any) -> Any:
            Tripping.armed = plan.episode_id in poison
            return worker_run(plan, snapshot)

        self._worker.run = tripping  # type: ignore[method-assign]


class Silent:
    def progress(self, iteration: int, phase: str, done: int, total: int) -> None: ...

    def finished(self, row: dict[str, Any]) -> None: ...


@pytest.fixture
def this(tmp_path: Path) -> Run:
    config = Config.model_validate(CONFIG)
    return catalog.create(tmp_path, "tripped", config.to_json())


def trained(this: Run, poison: set[int]) -> None:
    executor = Executor(Config.model_validate(CONFIG), this, poison)
    try:
        loop.train(executor.config, this, executor, Silent())
    finally:
        executor.close()


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["t6gps", *arguments])
    main.main()


def test_t3_a_run_goes_on_without_a_poison_episode_and_keeps_its_last_states(
    this: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained(this, {POISON})
    assert tables.read(this, "episodes")["episode_id"].to_pylist() == [0, 2]
    assert tables.read(this, "iterations").select(["episodes", "left_out"]).to_pylist() == [
        {"episodes": 2, "left_out": 1}
    ]
    latest = checkpoint.load_latest(this.checkpoints)
    assert latest is not None
    ledger: Any = latest[1]["ledger"]
    assert ledger["counters"]["quarantined"] == 1
    assert ledger["counters"]["committed"] == 2
    path = this.bundles / f"episode-{POISON}.json"
    kept = crash_bundle.read(path)
    assert kept.plan == seeding.training_plans(Config.model_validate(CONFIG), 0)[POISON]
    assert len(kept.failures) == 3
    for failure in kept.failures:
        assert (failure["error"], failure["step"], failure["seed"]) == ("PhysicsError", STEP, kept.plan.seed)
        assert "the robot tripped" in failure["trace"]
        assert [np.shape(state["bar_positions"]) for state in failure["states"]] == [(6, 3)] * 5
    with pytest.raises(SystemExit):
        command(monkeypatch, "replay", str(path), "--json")
    found = json.loads(capsys.readouterr().out)
    assert (found["now"], found["steps"], found["ended_by"]) == ("succeeded", 30, "completed")


def test_a_poison_episode_is_not_tried_again_until_its_bundle_is_removed(this: Run) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "commit_iteration", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            trained(this, {POISON})
    (this.bundles / f"episode-{POISON}.json").unlink()
    trained(this, set())
    assert tables.read(this, "episodes")["episode_id"].to_pylist() == [0, 1, 2]


def test_a_run_in_which_every_episode_fails_ends_with_one_sentence(this: Run) -> None:
    with pytest.raises(RunError, match=r"nothing but failures comes back; the last: episode 2: PhysicsError.*tripped"):
        trained(this, {0, 1, 2})
    with pytest.raises(RunError, match="every episode of iteration 0 is left out"):
        trained(this, set())


def test_what_is_not_a_bundle_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.json"
    other.write_text("{}")
    for path in (tmp_path / "none.json", other):
        with pytest.raises(SystemExit) as ended:
            command(monkeypatch, "replay", str(path))
        assert ended.value.code == 2
        assert "is not a crash bundle" in capsys.readouterr().err
