"""Laws of a study: arms times seeds as ordinary runs, resumed without repetition, and a folder with the numbers."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from t6gps.service import config
from t6gps.service.execution.serial import new_learner
from t6gps.service.studies import arm_figures, baselines, conduct, declared, ground_figures, report
from t6gps.service.studies.conduct import Finished, Trial
from t6gps.service.studies.declared import PAPER, STUDIES, Arm, Baseline, Scale, Study
from t6gps.service.training import evaluation
from t6gps.service.training.study_origin import EARLIER_FILE, FILE, Origin, origin, recorded
from t6gps.storage import catalog, tables
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.episode import policy
from t6gps.workers.ground.ground import tilted
from t6gps.workers.ground.terrain import Terrain

TINY = (
    "run.iterations=1",
    "run.episodes=4",
    "run.steps=40",
    "run.evaluation_episodes=2",
    "learner.smallest_class_segments=4",
    "learner.epochs=1",
    "learner.hidden_layers=[8]",
)
PAIR = Study(
    question="Does a long horizon help?",
    arms={
        "short": Arm("short", "flat", "flat-quick", ("learner.horizon_steps=5",)),
        "long": Arm("long", "flat", "flat-quick", ("learner.horizon_steps=20",)),
    },
    quick=TINY,
    quick_seeds=1,
    figures=(
        "speed_distribution",
        "modes_per_class",
        "ground_track",
        "footprints",
        "climbs",
        "any_axis",
        "grades",
        "conditions",
        "along_training",
    ),
    conditions={"tilted": ("terrain.tilt_deg=20",)},
)


class Listener:
    """Watches a study, keeps what it says, and counts the runs that it trains or evaluates."""

    def __init__(self, stop_at: str = "") -> None:
        self.sentences: list[str] = []
        self.warnings: list[str] = []
        self.runs_n = 0
        self._stop_at = stop_at

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)

    def warn(self, sentence: str) -> None:
        self.warnings.append(sentence)

    def run(self, iterations: int) -> AbstractContextManager[Listener]:
        assert iterations > 0
        self.runs_n += 1
        return nullcontext(self)

    def task(self, title: str) -> AbstractContextManager[Callable[[int, int], None]]:
        assert title.startswith("training ")
        return nullcontext(lambda done, total: None)

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if phase == self._stop_at:
            raise KeyboardInterrupt

    def finished(self, row: dict[str, Any]) -> None:
        assert row["episodes"] == 4


def conducted(
    root: Path, planned: Sequence[Trial], watcher: Listener | None = None, present: str | None = None
) -> list[Finished]:
    return conduct.conduct(planned, root, "pair", PAIR.conditions, True, watcher or Listener(), present)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Finished]]:
    """A finished study of two runs and its root."""
    root = tmp_path_factory.mktemp("root")
    return root, conducted(root, conduct.trials("pair", PAIR, Scale.QUICK))


@pytest.mark.parametrize("name", STUDIES)
@pytest.mark.parametrize("scale", Scale)
def test_every_study_expands_to_each_arm_with_each_seed(name: str, scale: Scale) -> None:
    chosen = declared.find(name)
    planned = conduct.trials(name, chosen, scale, seeds=2)
    arms = chosen.arms_at(scale)
    assert [(trial.arm, trial.seed) for trial in planned] == [(arm, seed) for seed in (0, 1) for arm in arms]
    for trial in planned:
        catalog.check_name(trial.name)
        assert trial.config.run.seed == trial.seed
    assert len({trial.name for trial in planned}) == len(planned)
    assert len({(trial.declared.baseline, trial.config.model_dump_json()) for trial in planned}) == len(planned)


def test_arms_differ_from_their_preset_in_what_they_declare_alone() -> None:
    planned = {trial.arm: trial.config for trial in conduct.trials("surrogate", STUDIES["surrogate"], Scale.PAPER)}
    com, nodes = planned["com-slow"], planned["nodes-vels-slow"]
    assert (com.learner.reduced_state, nodes.learner.reduced_state) == ("com", "nodes+vels")
    assert nodes.model_copy(update={"learner": com.learner}) == com
    assert (com.run.episodes, com.run.steps, com.run.iterations) == (300, 250, 5), PAPER
    assert com.robot.winch_speed_m_per_s == 0.3


@pytest.mark.parametrize("name", STUDIES)
def test_a_quick_study_is_estimated_below_half_an_hour(name: str) -> None:
    chosen = declared.find(name)
    assert conduct.estimate_s(conduct.trials(name, chosen, Scale.QUICK), len(chosen.conditions)) < 30 * 60


def test_a_pattern_chooses_arms() -> None:
    planned = conduct.trials("horizon", STUDIES["horizon"], Scale.QUICK, 1, arms="*-fast")
    assert [trial.arm for trial in planned] == ["5-steps-fast", "10-steps-fast", "15-steps-fast", "20-steps-fast"]
    with pytest.raises(ConfigError, match=r"no arm that matches 'fast\*' at this scale; allowed: 5-steps-fast"):
        conduct.trials("horizon", STUDIES["horizon"], Scale.QUICK, 1, arms="fast*")


def test_runs_of_a_study_are_ordinary_runs_with_their_origin(pair: tuple[Path, list[Finished]]) -> None:
    root, finished = pair
    assert [run.name for run in catalog.list_runs(root)] == ["pair-quick-long-0", "pair-quick-short-0"]
    for outcome in finished:
        assert tables.committed_iterations(outcome.run) == 1
        assert evaluation.kept(outcome.run) == outcome.evaluation
        assert outcome.origin.arm == outcome.trial.arm
        assert outcome.origin.wall_s > 0
        assert len(outcome.origin.commits) == 1
        assert len(list(outcome.run.figures.glob("*.png"))) == 3


def test_the_folder_holds_tables_figures_and_how_they_were_made(
    pair: tuple[Path, list[Finished]], tmp_path: Path
) -> None:
    _, finished = pair
    files = report.write(tmp_path / "out", "pair", PAIR, ["t6gps", "study", "pair"], finished)
    assert {file.name for file in files} == {file.name for file in (tmp_path / "out").iterdir()}
    figures = {"evaluations", "learning", *PAIR.figures}
    assert {file.stem for file in files if file.suffix == ".png"} == figures
    with (tmp_path / "out" / "table.csv").open() as file:
        rows = {row["arm"]: row for row in csv.DictReader(file)}
    for outcome in finished:
        mean = outcome.evaluation.forward_speed_m_per_s.mean
        assert float(rows[outcome.trial.arm]["forward_speed_m_per_s"]) == pytest.approx(mean)
        assert rows[outcome.trial.arm]["forward_speed_m_per_s_deviation"] == "", "one seed has none"
        steps = tables.read(outcome.run, "iterations", ["steps"])["steps"].to_pylist()
        assert float(rows[outcome.trial.arm]["steps"]) == sum(steps), "what was sampled, not what was planned"
    page = (tmp_path / "out" / "README.md").read_text()
    for words in (PAIR.question, "    t6gps study pair", "seeds 0", finished[0].origin.commits[0], "wall time"):
        assert words in page
    widths = {line.count("|") for line in page.splitlines() if line.startswith("|")}
    assert len(widths) == 2, "one table of arms, one of conditions, each with as many cells in every row"
    assert page.count("cost of transport") == 2
    for outcome in finished:
        assert f"t6gps train flat-quick --run {outcome.run.name} --set=" in page


def test_a_study_run_again_skips_what_is_finished(pair: tuple[Path, list[Finished]]) -> None:
    root, finished = pair
    watcher = Listener()
    again = conducted(root, conduct.trials("pair", PAIR, Scale.QUICK), watcher)
    assert watcher.runs_n == 0
    assert watcher.sentences == [
        "2 runs, 2 of them finished, 0 evaluations under other conditions to come: about 0 s on two idle cores"
    ]
    assert again == finished


def test_a_stopped_study_resumes_the_unfinished_run(pair: tuple[Path, list[Finished]], tmp_path: Path) -> None:
    _, finished = pair
    planned = conduct.trials("pair", PAIR, Scale.QUICK)
    with pytest.raises(KeyboardInterrupt):
        conducted(tmp_path, planned, Listener(stop_at="evaluate"))
    run = catalog.open_run(tmp_path, "pair-quick-short-0")
    assert tables.committed_iterations(run) == 1
    assert evaluation.kept(run) is None
    before_s = origin(run).wall_s
    resumed = conducted(tmp_path, planned)
    assert [outcome.evaluation for outcome in resumed] == [outcome.evaluation for outcome in finished]
    assert origin(run).wall_s > before_s


def test_runs_of_another_configuration_are_refused(pair: tuple[Path, list[Finished]]) -> None:
    root, _ = pair
    planned = conduct.trials("pair", PAIR, Scale.QUICK, overrides=["learner.kl_weight=0.5"])
    with pytest.raises(RunError, match=r"pair-quick-short-0 has another configuration: learner.kl_weight = 0.5"):
        conducted(root, planned)


def test_runs_of_another_commit_are_kept_with_a_warning(pair: tuple[Path, list[Finished]]) -> None:
    root, finished = pair
    watcher = Listener()
    conducted(root, conduct.trials("pair", PAIR, Scale.QUICK), watcher, present="another")
    began = f"run pair-quick-long-0 comes from commit {finished[0].origin.commits[0]}, this is another"
    assert any(warning.startswith(began) for warning in watcher.warnings)
    record = json.loads((finished[0].run.path / FILE).read_text())
    assert record == asdict(finished[0].origin) | {"commits": list(finished[0].origin.commits)}


def test_an_origin_adds_up_the_commits_and_the_time_of_each_part(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "tried", config.load("flat-quick").to_json())
    assert origin(run) == Origin()
    for commit in ("a", "b", "a"):
        with recorded(run, "pair", "short", 0, commit):
            pass
    with pytest.raises(KeyboardInterrupt), recorded(run, "pair", "short", 0, "c"):
        raise KeyboardInterrupt
    found = origin(run)
    assert found == Origin("pair", "short", 0, ("a", "b", "c"), found.wall_s, os.cpu_count())
    (run.path / FILE).rename(run.path / EARLIER_FILE)
    assert origin(run) == found


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["learner.horizon_steps=41"], "learner.horizon_steps = 41 is longer than an episode of run.steps = 40"),
        (["run.episodes=1"], "1 episodes of 40 steps cannot fill a segment class, which takes .* 80 steps"),
        (["learner.reduced_state=positions"], "learner.reduced_state must be 'com', .* found 'positions'"),
    ],
)
def test_a_study_that_cannot_learn_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        conduct.trials("pair", PAIR, Scale.QUICK, overrides=overrides)


def test_an_unknown_study_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown study 'horizont' \(did you mean horizon\?\); allowed: surrogate"):
        declared.find("horizont")


@pytest.mark.slow
@pytest.mark.parametrize("baseline", Baseline)
def test_a_baseline_is_evaluated_on_the_episodes_of_its_run_and_kept(baseline: Baseline, tmp_path: Path) -> None:
    arm = Arm("baseline", "flat", "flat-quick", ("learner.value_from=0",), baseline=baseline)
    study = Study(
        question="",
        arms={"baseline": arm},
        quick=("run.iterations=1", "run.episodes=5", "run.steps=250", "run.evaluation_episodes=2"),
        quick_seeds=1,
        figures=("conditions",),
        conditions={"one-way": ("task.directions=1", "run.steps=20")},
    )
    planned = conduct.trials("baselines", study, Scale.QUICK)
    first = conduct.conduct(planned, tmp_path, "baselines", study.conditions, True, Listener())
    again = conduct.conduct(planned, tmp_path, "baselines", study.conditions, True, Listener())
    assert first == again
    assert first[0].evaluation.episodes == 2
    assert first[0].evaluation.forward_speed_m_per_s.standard_error > 0
    assert first[0].conditions["one-way"].forward_speed_m_per_s.standard_error == 0
    assert report.arm_rows(first)[0]["steps"] == (0 if baseline is Baseline.FLOP else 1250)
    files = report.write(tmp_path / "out", "baselines", study, ["t6gps", "study", "baselines"], first)
    assert {file.stem for file in files if file.suffix == ".png"} == {"evaluations", "conditions"}
    assert "| baseline | one-way |" in (tmp_path / "out" / "README.md").read_text()


def test_the_workers_command_what_ppo_commands_on_average() -> None:
    settings = config.load("flat-quick", ["learner.value_from=0"])
    model = baselines.new_ppo(settings)
    learner = new_learner(settings)
    learner.restore(*baselines.learner_state(model, settings))
    observations = np.random.default_rng(0).uniform(-1, 1, (5, OBSERVATION_N)).astype(np.float32)
    for observation in observations:
        commands = 1.0 + 0.5 * model.predict(observation, deterministic=True)[0]
        np.testing.assert_allclose(policy.ready(learner.snapshot)(observation), commands, atol=1e-5)


def test_evolution_spends_its_steps_in_whole_generations() -> None:
    settings = config.load("flat-quick")
    generations: list[int] = []
    best = baselines.evolve(settings, 3 * 1200 + 7, lambda done, _: generations.append(done))
    assert generations == [1, 2, 3]
    assert best.shape == (49,)
    with pytest.raises(RunError, match="1199 steps make up no generation of 12 x 100"):
        baselines.evolve(settings, 1199, lambda *_: None)


def test_every_arm_is_drawn(pair: tuple[Path, list[Finished]]) -> None:
    _, finished = pair
    labels = [str(number) for number in range(11)]
    many = [
        replace(finished[0], trial=replace(finished[0].trial, declared=replace(PAIR.arms["short"], label=label)))
        for label in labels
    ]
    axes = arm_figures.evaluations(many).get_axes()[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == labels
    assert len(axes.get_lines()) == len(labels)
    legend = arm_figures.learning(many).get_axes()[0].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == labels


def test_the_slope_of_a_tilted_plane_is_its_tilt() -> None:
    plane = tilted(Terrain(np.zeros((401, 401)), 0.1), 20.0)
    place = np.array([[0.0, 0.0], [5.0, -3.0]])
    np.testing.assert_allclose(ground_figures.slope(plane, place), [[np.tan(np.radians(20.0)), 0.0]] * 2, atol=1e-12)
