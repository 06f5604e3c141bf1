"""Laws of the training loop: a run that was stopped anywhere resumes as if it had not been."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_digest import digests
from tiny_run import TINY, Trained, Watcher

from t6gps.learner.phases import PHASES, Phase
from t6gps.service.config import Config, load
from t6gps.service.execution.executor import Keep, Purpose
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.training import evaluation, loop
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import EpisodePlan, PolicySnapshot

PHASES_BY_NAME = {phase.name: phase for phase in PHASES}
pytestmark = pytest.mark.slow


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


def trained(config: Config, run: Run, executor: SerialExecutor) -> Watcher:
    watcher = Watcher()
    try:
        loop.train(config, run, executor, watcher)
    finally:
        executor.close()
    return watcher


@pytest.fixture(scope="module")
def config(tiny: Trained) -> Config:
    return tiny.config


@pytest.fixture(scope="module")
def whole(tiny: Trained) -> dict[str, str]:
    """Digests of an uninterrupted run, without its evaluation."""
    return {part: digest for part, digest in tiny.digests.items() if not part.startswith("evaluation")}


@pytest.mark.parametrize("stop", [{"episodes": 0}, {"episodes": 4}, *({"phase": phase} for phase in PHASES_BY_NAME)])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    config: Config, whole: dict[str, str], tmp_path: Path, stop: dict[str, Any]
) -> None:
    run = catalog.create(tmp_path, "stopped", config.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(config, run, StopsAfter(config, **stop))
    watcher = trained(config, run, SerialExecutor(config))
    assert digests(run.path) == whole
    assert watcher.phases == {"sample", *PHASES_BY_NAME}
    assert [row["iteration"] for row in watcher.rows] == [0, 1, 2][-len(watcher.rows) :]


def test_a_resumed_run_that_follows_an_action_value_reads_what_it_needs_from_its_tables(tmp_path: Path) -> None:
    few = ("learner.action_value.first_steps=20", "learner.action_value.steps=10")
    config = load("flat-quick", [*TINY, "learner.value_from=1", *few])
    whole, stopped = (catalog.create(tmp_path, name, config.to_json()) for name in ("whole", "stopped"))
    trained(config, whole, SerialExecutor(config))
    for stop in (StopsAfter(config, phase="backward_pass"), StopsAfter(config, episodes=1)):  # iterations 1 and 2
        with pytest.raises(KeyboardInterrupt):
            trained(config, stopped, stop)
    assert tables.committed_iterations(stopped) == 2
    trained(config, stopped, SerialExecutor(config))
    assert digests(stopped.path) == digests(whole.path)


def test_a_policy_that_stays_does_not_depart_from_itself_also_within_the_reach(tmp_path: Path) -> None:
    few = ("learner.action_value.first_steps=2", "learner.action_value.steps=2", "learner.learning_rate=1e-9")
    config = load("flat-quick", [*TINY, "learner.value_from=1", *few, "learner.action_value.reach_noise=1"])
    run = catalog.create(tmp_path, "still", config.to_json())
    trained(config, run, SerialExecutor(config))
    assert max(row["policy_kl"] for row in tables.read(run, "iterations", ["policy_kl"]).to_pylist()) < 1e-6


def test_a_crash_between_commit_and_checkpoint_changes_nothing(
    config: Config, whole: dict[str, str], tmp_path: Path
) -> None:
    run = catalog.create(tmp_path, "crashed", config.to_json())
    obstacle = run.checkpoints / ".iteration-000001.partial"
    obstacle.touch()  # where the first checkpoint's folder is to be
    with pytest.raises(OSError, match=obstacle.name):
        trained(config, run, SerialExecutor(config))
    assert tables.committed_iterations(run) == 1
    assert checkpoint.load_latest(run.checkpoints) is None
    obstacle.unlink()
    trained(config, run, SerialExecutor(config))
    assert digests(run.path) == whole


@pytest.fixture(scope="module")
def pipelined() -> Config:
    return load("flat-quick", [*TINY, "run.pipelined=true"])


@pytest.fixture(scope="module")
def in_turn(pipelined: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A pipelined run in which nothing is sampled ahead."""
    run = catalog.create(tmp_path_factory.mktemp("runs"), "in-turn", pipelined.to_json())
    trained(pipelined, run, SerialExecutor(pipelined))
    return run


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
    run = catalog.create(tmp_path, "stopped", pipelined.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(pipelined, run, SamplesAhead(pipelined, **stop))
    trained(pipelined, run, SamplesAhead(pipelined, episodes=left))
    assert digests(run.path) == digests(in_turn.path)


def test_spooled_episodes_are_not_sampled_again(config: Config, tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "stopped", config.to_json())
    with pytest.raises(KeyboardInterrupt):
        trained(config, run, StopsAfter(config, episodes=2))
    trained(config, run, StopsAfter(config, episodes=config.run.iterations * config.run.episodes - 2))


def test_the_iterations_table_summarises_its_episodes(tiny: Trained) -> None:
    episodes = tables.read(tiny.run, "episodes")
    for row in tables.read(tiny.run, "iterations").to_pylist():
        cost = np.array([e["cost"] for e in episodes.to_pylist() if e["iteration"] == row["iteration"]])
        assert row["cost"] == pytest.approx(cost.mean())
        assert row["cost_standard_error"] == pytest.approx(cost.std(ddof=1) / np.sqrt(len(cost)))
        assert row["steps"] == 90
        assert row["policy_version"] == row["iteration"]


def test_the_realised_change_of_cost_is_that_since_the_iteration_that_trained_the_policy(
    tiny: Trained, in_turn: Run
) -> None:
    for run in (tiny.run, in_turn):  # that is the iteration before, in a pipelined run the one before that
        rows = tables.read(run, "iterations").sort_by("iteration").to_pylist()
        assert {row["policy_version"] for row in rows} >= {0, 1}
        for row in rows:
            version = row["policy_version"]
            assert row["realised_cost_change"] == (row["cost"] - rows[version - 1]["cost"] if version else None)


def test_an_evaluation_is_noise_free_repeatable_and_kept(tiny: Trained, tmp_path: Path) -> None:
    latest = checkpoint.load_latest(tiny.run.checkpoints)
    assert latest is not None
    results = []
    for _ in range(2):
        executor = SerialExecutor(tiny.config)
        executor.learner.restore(*latest[1:])
        results.append(evaluation.evaluate(tiny.config, executor, 3, seed=1, terrain_seed=None, observer=Watcher()))
        executor.close()
    assert results[0] == results[1]
    run = catalog.create(tmp_path, "evaluated", tiny.config.to_json())
    assert evaluation.kept(run) is None
    evaluation.keep(run, results[0])
    assert evaluation.kept(run) == results[0]


class SamplesNothing(SerialExecutor):
    """All episodes are quarantined."""

    def sample(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        keep: Keep,
        purpose: Purpose = Purpose.TRAINING,
    ) -> None: ...


def test_an_evaluation_of_which_every_episode_is_quarantined_says_so(config: Config) -> None:
    executor = SamplesNothing(config)
    with pytest.raises(RunError, match="every episode of the evaluation is quarantined"):
        evaluation.evaluate(config, executor, 3, seed=1, terrain_seed=None, observer=Watcher())
    executor.close()
