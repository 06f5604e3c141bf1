"""Laws of a rival's run: it repeats, is evaluated along its training, and starts nothing without its library."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.studies import arm_figures, conduct, libraries, report
from t6gps.service.studies.declared import BY_HAND, STUDIES, Arm, Baseline, Rival, Scale, Study
from t6gps.service.studies.rivals import arms, curve, settings
from t6gps.service.studies.watcher import Progress
from t6gps.service.training import evaluation
from t6gps.service.training.loop import Observer
from t6gps.storage import catalog, tables
from t6gps.storage.errors import ConfigError
from t6gps.workers.episode.rollout import controlled
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length

LEARNERS = {
    Rival.SAC_RATES: (1020, 1060),
    Rival.TQC_ABSOLUTE: (1020, 1060),
    Rival.CROSSQ_RATES: (1020, 1060),
    Rival.PPO_ABSOLUTE: (2500,),
}
"""Each algorithm, and control steps around its first updates."""
SHORT = ("run.iterations=1", "run.episodes=5", "run.steps=250", "run.evaluation_episodes=2")
GAITS = Study(
    question="Which gait?",
    arms={name.value: Arm(name.value, "rough ground", "rough", baseline=name) for name in (Rival.GAIT, Rival.CPG)},
    quick=("run.iterations=1", "run.episodes=6", "run.steps=250", "run.evaluation_episodes=2"),
    quick_seeds=1,
    figures=("along_training",),
)


class Watcher:
    """Watches a study; may interrupt it while some rival trains."""

    def __init__(self, stop_in: str = "") -> None:
        self.titles: list[str] = []
        self._stop_in = stop_in

    def say(self, sentence: str) -> None:
        assert sentence

    def warn(self, sentence: str) -> None:
        raise AssertionError(sentence)

    def run(self, iterations: int) -> AbstractContextManager[Observer]:
        raise AssertionError(f"a run of {iterations} iterations, where only rivals are asked for")

    def task(self, title: str) -> AbstractContextManager[Progress]:
        self.titles.append(title)
        return nullcontext(self._progress)

    def _progress(self, done: int, total: int) -> None:
        assert 0 < done <= total
        if self.titles[-1] == self._stop_in:
            raise KeyboardInterrupt


def conducted(root: Path, watcher: Watcher) -> list[conduct.Finished]:
    return conduct.conduct(conduct.trials("gaits", GAITS, Scale.QUICK), root, "gaits", {}, True, watcher)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[conduct.Finished]]:
    root = tmp_path_factory.mktemp("gaits")
    return root, conducted(root, Watcher())


def test_the_study_has_an_arm_for_each_rival_and_t6gps_at_each_budget() -> None:
    planned = {trial.arm: trial for trial in conduct.trials("rivals", STUDIES["rivals"], Scale.PAPER, 1)}
    steps = {"t6gps": 375_000, "t6gps-75k": 75_000, "t6gps-125k": 125_000}
    assert {arm: planned[arm].training_steps for arm in steps} == steps
    assert planned.keys() == {*steps, *(rival.value for rival in Rival)}
    for rival in Rival:
        marks = arms.marks_of(rival, planned[rival.value].config)
        assert marks == ([375_000] if rival in BY_HAND else [10_000, 25_000, 75_000, 125_000, 375_000])
        assert all(mark % settings.PPO.rollout == 0 for mark in marks)
        assert all(mark % settings.SAC.steps_per_update == 0 for mark in marks)


def test_a_rival_is_evaluated_and_kept_as_any_run(finished: tuple[Path, list[conduct.Finished]]) -> None:
    root, outcomes = finished
    steps = {"gait": [0], "cpg": [1400]}
    for outcome in outcomes:
        assert [point.steps for point in outcome.curve] == steps[outcome.trial.arm]
        assert outcome.curve[-1].evaluation == outcome.evaluation
        kept = tables.read(outcome.run, "evaluations").to_pylist()
        assert [(row["purpose"], row["episodes"]) for row in kept] == [("training", 2)]
        assert kept[0]["forward_speed_m_per_s"] == outcome.evaluation.forward_speed_m_per_s.mean
    watcher = Watcher()
    assert conducted(root, watcher) == outcomes
    assert not watcher.titles, "what is finished is not run again"


def test_the_folder_of_a_study_shows_rivals_along_their_training(
    finished: tuple[Path, list[conduct.Finished]], tmp_path: Path
) -> None:
    files = report.write(tmp_path / "out", "gaits", GAITS, ["t6gps", "study", "gaits"], finished[1])
    assert {"curves.csv", "along_training.png"} <= {file.name for file in files}
    axes = arm_figures.along_training(finished[1]).get_axes()[0]
    assert [line.get_xdata().tolist() for line in axes.get_lines()] == [[0], [1400]]
    page = (tmp_path / "out" / "README.md").read_text()
    assert "| cpg | 1 | 1,400 |" in page
    assert "| gait | 1 | 0 |" in page


@pytest.mark.slow
def test_an_interrupted_rival_begins_anew_and_ends_alike(
    finished: tuple[Path, list[conduct.Finished]], tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        conducted(tmp_path, Watcher(stop_in="training cpg"))
    cpg = catalog.open_run(tmp_path, "gaits-quick-cpg-0")
    assert (evaluation.kept(cpg), curve.kept(cpg)) == (None, [])
    again = conducted(tmp_path, Watcher())
    assert [outcome.evaluation for outcome in again] == [outcome.evaluation for outcome in finished[1]]


@pytest.mark.slow
@pytest.mark.parametrize("rival", LEARNERS)
def test_a_learner_repeats_itself_keeps_to_its_marks_and_is_no_other(rival: Rival) -> None:
    config, marks = configuration.load("rough", SHORT), LEARNERS[rival]
    first, again = (outcomes(rival, config, marks) for _ in range(2))
    assert first == again
    assert [steps for steps, _ in first] == list(marks)
    assert len({cost for _, cost in first}) == len(marks), "it learns between marks"


def outcomes(rival: Rival, config: Config, marks: tuple[int, ...]) -> list[tuple[int, float]]:
    """Steps at each mark, and the cost of what is learned in one episode."""
    plan = seeding.evaluation_plans(config, 1, 0, None, 0)[0]
    nominal_m = nominal_rest_length(config.robot)
    with PyBulletEngine(config.robot) as engine:
        return [
            (
                trained.steps,
                controlled(engine, config.rollout, plan, trained.control, 0, nominal_m).summary["cost"][0].as_py(),
            )
            for trained in arms.learner(rival)(config, marks, lambda done, total: None)
        ]


@pytest.mark.parametrize(
    ("baseline", "module", "words"),
    [
        (Rival.CPG, "cmaes", r"arm first needs cmaes, .* pip install 't6gps\[rivals\]'"),
        (Rival.CROSSQ_RATES, "sb3_contrib", r"arm first needs sb3-contrib, .* pip install 't6gps\[rivals\]'"),
        (Baseline.PPO, "stable_baselines3", r"needs stable-baselines3, .* pip install 't6gps\[baselines\]'"),
    ],
)
def test_a_missing_library_is_named_before_anything_is_sampled(
    baseline: Baseline | Rival, module: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study(
        "", {name: Arm(name, "", "rough", baseline=baseline) for name in ("first", "second")}, SHORT, quick_seeds=1
    )
    monkeypatch.setitem(sys.modules, module, None)  # as Python remembers what cannot be imported
    with pytest.raises(ConfigError, match=words):
        conduct.conduct(conduct.trials("rivals", study, Scale.QUICK), tmp_path, "rivals", {}, True, Watcher())
    assert not catalog.list_runs(tmp_path)


def test_every_library_that_an_arm_may_need_is_there() -> None:
    libraries.check_installed({arm: each.baseline for arm, each in STUDIES["rivals"].arms.items()})
