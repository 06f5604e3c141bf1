"""Laws of the training loop: a run that was stopped anywhere goes on as if it had not been."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from t6gps.learner.improvers import action_value as value
from t6gps.learner.phases import PHASES, Phase
from t6gps.service.config import Config, load
from t6gps.service.execution.executor import Keep, Purpose
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.training import evaluation, loop
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.records import EpisodePlan, PolicySnapshot

TINY = [
    "run.iterations=3",
    "run.episodes=3",
    "run.steps=30",
    "learner.smallest_class_segments=4",
    "learner.epochs=2",
    "learner.replay_iterations=1",
    "learner.hidden_layers=[16]",
]


PHASES_BY_NAME = {phase.name: phase for phase in PHASES}


class Silent:
    """Counts what it is told."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.phases: set[str] = set()

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        assert 0 <= done <= total
        self.phases.add(phase)

    def finished(self, row: dict[str, Any]) -> None:
        self.rows.append(row)


class StopsAfter(SerialExecutor):
    """Stops the run, as Ctrl-C would, before its nth episode or in a phase of iteration 1."""

    def __init__(self, config: Config, episodes: int | None = None, phase: str | None = None) -> None:
        super().__init__(config)
        self._episodes, self._phase, self._learned = episodes, phase, 0

    def sample(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        keep: Keep,
        purpose: Purpose = Purpose.TRAINING,
    ) -> None:
        for plan in plans:
            if self._episodes == 0:
                raise KeyboardInterrupt
            self._episodes = None if self._episodes is None else self._episodes - 1
            super().sample([plan], snapshot, keep, purpose)

    def learn(self, phase: Phase) -> Iterator[tuple[int, int]]:
        self._learned += phase.name == "segment"
        if phase.name == self._phase and self._learned == 2:
            raise KeyboardInterrupt
        return super().learn(phase)


class SamplesAhead(StopsAfter):
    """Has two episodes of the next iteration in the spool when the learner begins, as workers may have."""

    def sample_ahead(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Keep) -> None:
        self.sample(plans[:2], snapshot, keep)


def trained(config: Config, this: Run, executor: SerialExecutor) -> Silent:
    observer = Silent()
    try:
        loop.train(config, this, executor, observer)
    finally:
        executor.close()
    return observer


def kept(this: Run) -> tuple[Any, Any, list[bytes]]:
    """Everything of a run that must not depend on interruptions."""
    latest = checkpoint.load_latest(this.checkpoints)
    assert latest is not None
    weights = [latest[2][name].tobytes() for name in sorted(latest[2])]
    order = [("episode_id", "ascending"), ("step", "ascending")]
    return tables.read(this, "frames").sort_by(order), tables.read(this, "episodes").sort_by("episode_id"), weights


@pytest.fixture(scope="module")
def config() -> Config:
    return load("flat-quick", TINY)


@pytest.fixture(scope="module")
def uninterrupted(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    this = catalog.create(tmp_path_factory.mktemp("runs"), "whole", config.to_json())
    observer = trained(config, this, SerialExecutor(config))
    assert [row["iteration"] for row in observer.rows] == [0, 1, 2]
    assert observer.phases == {"sample", *PHASES_BY_NAME}
    return this


@pytest.mark.parametrize("stop", [{"episodes": 0}, {"episodes": 4}, *({"phase": phase} for phase in PHASES_BY_NAME)])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    config: Config, uninterrupted: Run, tmp_path: Path, stop: dict[str, Any]
) -> None:
    this = catalog.create(tmp_path, "stopped", config.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(config, this, StopsAfter(config, **stop))
    trained(config, this, SerialExecutor(config))
    for found, expected in zip(kept(this), kept(uninterrupted), strict=True):
        assert found == expected


@pytest.mark.parametrize("stop", [{"episodes": 7}, {"phase": "backward_pass"}])
def test_a_resumed_run_that_follows_an_action_value_reads_what_it_needs_from_its_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: dict[str, Any]
) -> None:
    for name in ("STEPS", "FIRST_STEPS"):
        monkeypatch.setattr(value, name, value.PREPARED_N)
    config = load("flat-quick", [*TINY, "learner.value_from=1"])
    whole, stopped = (catalog.create(tmp_path, name, config.to_json()) for name in ("whole", "stopped"))
    trained(config, whole, SerialExecutor(config))
    with pytest.raises(KeyboardInterrupt):
        trained(config, stopped, StopsAfter(config, **stop))
    trained(config, stopped, SerialExecutor(config))
    for found, expected in zip(kept(stopped), kept(whole), strict=True):
        assert found == expected


@pytest.mark.parametrize("step", ["tables.commit_iteration", "checkpoint.save"])
def test_a_crash_between_commit_and_checkpoint_changes_nothing(
    config: Config, uninterrupted: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    this = catalog.create(tmp_path, "crashed", config.to_json())
    module, name = step.split(".")
    whole = getattr(getattr(loop, module), name)

    def crashing(*arguments: Any) -> None:
        if name == "commit_iteration":
            whole(*arguments)
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(getattr(loop, module), name, crashing)
        with pytest.raises(OSError, match="no space"):
            trained(config, this, SerialExecutor(config))
    trained(config, this, SerialExecutor(config))
    for found, expected in zip(kept(this), kept(uninterrupted), strict=True):
        assert found == expected
    assert tables.read(this, "iterations")["iteration"].to_pylist() == [0, 1, 2]


@pytest.fixture(scope="module")
def pipelined() -> Config:
    return load("flat-quick", [*TINY, "run.pipelined=true"])


@pytest.fixture(scope="module")
def in_turn(pipelined: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A pipelined run in which nothing is sampled ahead."""
    this = catalog.create(tmp_path_factory.mktemp("runs"), "in-turn", pipelined.to_json())
    trained(pipelined, this, SerialExecutor(pipelined))
    return this


def test_a_pipelined_run_holds_the_version_that_acted_in_every_row(in_turn: Run) -> None:
    for table in ("frames", "episodes", "iterations"):
        rows = tables.read(in_turn, table, ["iteration", "policy_version"]).to_pylist()
        assert {(row["iteration"], row["policy_version"]) for row in rows} == {(0, 0), (1, 0), (2, 1)}


@pytest.mark.parametrize(
    ("stop", "left"),
    [({"episodes": 1}, 8), ({"episodes": 4}, 5), ({"phase": "segment"}, 1), ({"phase": "supervise"}, 1)],
)
def test_a_pipelined_run_resumes_bit_for_bit_and_samples_nothing_twice(
    pipelined: Config, in_turn: Run, tmp_path: Path, stop: dict[str, Any], left: int
) -> None:
    this = catalog.create(tmp_path, "stopped", pipelined.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(pipelined, this, SamplesAhead(pipelined, **stop))
    trained(pipelined, this, SamplesAhead(pipelined, episodes=left))
    for found, expected in zip(kept(this), kept(in_turn), strict=True):
        assert found == expected


def test_spooled_episodes_are_not_sampled_again(config: Config, tmp_path: Path) -> None:
    this = catalog.create(tmp_path, "stopped", config.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(config, this, StopsAfter(config, episodes=2))
    counter = StopsAfter(config, episodes=config.run.iterations * config.run.episodes - 2)
    trained(config, this, counter)


def test_the_iterations_table_summarises_its_episodes(uninterrupted: Run) -> None:
    episodes = tables.read(uninterrupted, "episodes")
    for row in tables.read(uninterrupted, "iterations").to_pylist():
        cost = np.array([e["cost"] for e in episodes.to_pylist() if e["iteration"] == row["iteration"]])
        assert row["cost"] == pytest.approx(cost.mean())
        assert row["cost_standard_error"] == pytest.approx(cost.std(ddof=1) / np.sqrt(len(cost)))
        assert row["steps"] == 90
        assert row["policy_version"] == row["iteration"]


def test_an_evaluation_is_noise_free_repeatable_and_kept(config: Config, uninterrupted: Run) -> None:
    results = []
    for _ in range(2):
        executor = SerialExecutor(config)
        latest = checkpoint.load_latest(uninterrupted.checkpoints)
        assert latest is not None
        executor.learner.restore(*latest[1:])
        results.append(evaluation.evaluate(config, executor, 3, seed=1, terrain_seed=None, observer=Silent()))
        executor.close()
    assert results[0] == results[1]
    assert evaluation.kept(uninterrupted) is None
    evaluation.keep(uninterrupted, results[0])
    assert evaluation.kept(uninterrupted) == results[0]
