"""Conducts a study: its arms times its seeds as ordinary runs, and a folder with what came out.

A study that is run again resumes where it stopped. A run is finished when its evaluation is kept; an unfinished one is
resumed; what is there must have the configuration that the study asks for.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.service.provenance import commit
from t6gps.service.studies import baselines, libraries
from t6gps.service.studies.declared import BY_HAND, PAPER, PAPER_SEEDS, Arm, Baseline, Rival, Scale, Study
from t6gps.service.studies.rivals import arms as rivals
from t6gps.service.studies.rivals import curve
from t6gps.service.studies.rivals.curve import Point
from t6gps.service.studies.watcher import Watcher
from t6gps.service.training import evaluation, publishing, session
from t6gps.service.training import origin as run_origin
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.study_origin import Origin, origin, recorded
from t6gps.service.views import run_figures
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError
from t6gps.storage.objects.place import ObjectPath

SECONDS_PER_STEP = {True: 0.0005, False: 0.0003}
LEARNING_SECONDS_PER_STEP: dict[Baseline | Rival | None, float] = {
    rival: 0.01 for rival in Rival if rival.startswith(("sac", "tqc", "crossq"))
}
SECONDS_PER_RUN, SECONDS_PER_CONDITION = 10.0, 5.0
"""Of two idle cores, on rough and on flat ground, learning included; what an off-policy rival takes beside;
to start and to draw (for the estimate alone)."""


@dataclass(frozen=True)
class Trial:
    """One run of a study; `settings` are its overrides of the arm's preset."""

    name: str
    arm: str
    declared: Arm
    seed: int
    settings: tuple[str, ...]
    config: Config

    @property
    def evaluation_steps(self) -> int:
        """Control steps of its evaluation."""
        return self.config.run.evaluation_episodes * self.config.run.steps

    @property
    def training_steps(self) -> int:
        """Control steps that it learns from, I x N x T; none for a gait made by hand."""
        size = self.config.run
        return 0 if self.declared.baseline in BY_HAND else size.iterations * size.episodes * size.steps


@dataclass(frozen=True)
class Finished:
    """A trial with what it left: its run, the evaluation of its policy, those under other conditions, its origin.

    curve   a rival along its training, else empty
    """

    trial: Trial
    run: Run
    evaluation: Evaluation
    conditions: dict[str, Evaluation]
    origin: Origin
    curve: tuple[Point, ...] = ()


def trials(
    name: str,
    study: Study,
    scale: Scale,
    seeds: int | None = None,
    overrides: Sequence[str] = (),
    arms: str = "*",
) -> list[Trial]:
    """The arms that match a pattern, with every seed; seed by seed, so that a study stopped early is still balanced.

    A study that borrows its policies has the runs of the study that trains them. ConfigError where no arm matches, or
    for what no arm can learn from.
    """
    allowed = study.arms_at(scale)
    chosen = {arm: declared for arm, declared in allowed.items() if fnmatchcase(arm, arms)}
    if not chosen:
        raise ConfigError(f"study {name} has no arm that matches '{arms}' at this scale; allowed: {', '.join(allowed)}")
    size, seeds_n = (study.quick, study.quick_seeds) if scale is Scale.QUICK else (PAPER, PAPER_SEEDS)
    planned = []
    for seed in range(seeds_n if seeds is None else seeds):
        for arm, declared in chosen.items():
            settings = (*size, *declared.overrides, *declared.sizes.get(scale, ()), *overrides, f"run.seed={seed}")
            config = configuration.load(declared.preset, settings)
            check_learnable(config, f"arm {arm}")
            planned.append(
                Trial(f"{study.policies_of or name}-{scale}-{arm}-{seed}", arm, declared, seed, settings, config)
            )
    return planned


def check_learnable(config: Config, where: str) -> None:
    """ConfigError when an iteration is too small to fill one segment class."""
    size, learner = config.run, config.learner
    needed = learner.smallest_class_segments * learner.longest_segment_steps
    if size.episodes * size.steps < needed:
        raise ConfigError(
            f"{where}: {size.episodes} episodes of {size.steps} steps cannot fill a segment class, which takes "
            f"learner.smallest_class_segments x learner.longest_segment_steps = {needed} steps; raise run.episodes "
            "or run.steps, or lower learner.smallest_class_segments"
        )


def conduct(
    planned: Sequence[Trial],
    root: Path,
    study: str,
    conditions: Mapping[str, tuple[str, ...]],
    serial: bool,
    watcher: Watcher,
    present: str | None = None,
    copies: ObjectPath | None = None,
) -> list[Finished]:
    """Run what is missing of the trials below `root`, then evaluate each policy under `conditions` (overrides by name).

    Returns the results in the order of the plan. RunError if a run of that name has another configuration, ConfigError
    if an arm lacks a library, both before anything is sampled. Runs that another commit began are kept and said to be
    so; `present` is the commit at work, by default the one that is checked out.

    copies   root in an object store that gets a copy of each run; before anything is sampled StoreError where it takes
             none, RunError where it holds another run of such a name
    """
    present = present or commit()
    catalog.folder(root)
    runs = _begun(planned, root)
    _warn_of_other_commits(list(runs.values()), present, watcher)
    missing = [trial for trial in planned if trial.name not in runs or evaluation.kept(runs[trial.name]) is None]
    libraries.check_installed({trial.arm: trial.declared.baseline for trial in missing})
    if copies is not None:
        publishing.check_all([Run(catalog.whole(root) / trial.name) for trial in planned], copies, watcher.warn)
    unseen = [
        (trial, condition)
        for trial in planned
        for condition in conditions
        if trial.name not in runs or evaluation.kept(runs[trial.name], condition) is None
    ]
    left_s = estimate_s(missing, 0) + sum(_condition_s(trial) for trial, _ in unseen)
    watcher.say(
        f"{len(planned)} runs, {len(planned) - len(missing)} of them finished, {len(unseen)} evaluations under other "
        f"conditions to come: about {minutes(left_s)} on two idle cores"
    )
    pace = _Pace(left_s)
    for number, trial in enumerate(missing, len(planned) - len(missing) + 1):
        progress = f"run {number} of {len(planned)}: arm {trial.arm}, seed {trial.seed}"
        watcher.say(f"{progress}; {minutes(pace.left_s())} left")
        run = runs.get(trial.name) or run_origin.create(trial.config, root, trial.name)
        with recorded(run, study, trial.arm, trial.seed, present):
            _complete(trial, run, serial, watcher, copies)
        _publish([run], copies, watcher)
        pace.done(estimate_s([trial], 0))
    _see(unseen, root, conditions, serial, watcher, pace)
    _publish([catalog.open_run(root, trial.name) for trial in planned], copies, watcher)
    return [_finished(root, trial, conditions) for trial in planned]


def _see(
    unseen: Sequence[tuple[Trial, str]],
    root: Path,
    conditions: Mapping[str, tuple[str, ...]],
    serial: bool,
    watcher: Watcher,
    pace: _Pace,
) -> None:
    """Evaluate the policies of trials under other conditions."""
    for number, (trial, condition) in enumerate(unseen, 1):
        progress = f"condition {number} of {len(unseen)}: {condition}, run {trial.name}"
        watcher.say(f"{progress}; {minutes(pace.left_s())} left")
        run = catalog.open_run(root, trial.name)
        overrides = conditions[condition]
        evaluation.keep(run, _evaluated(trial, run, condition, overrides, serial, watcher), condition)
        pace.done(_condition_s(trial))


def _begun(planned: Sequence[Trial], root: Path) -> dict[str, Run]:
    """The trials' runs that are there, by name. RunError if one has another configuration than its trial."""
    there = {run.name: run for run in catalog.list_runs(root)}
    runs = {trial.name: there[trial.name] for trial in planned if trial.name in there}
    for trial in planned:
        if trial.name in runs:
            session.check_unchanged(
                runs[trial.name], trial.config, "give another --root, or the settings that the study was begun with"
            )
    return runs


def _publish(runs: Sequence[Run], copies: ObjectPath | None, watcher: Watcher) -> None:
    """Copy what is left to copy of runs that are finished as far as the study is."""
    if copies is None:
        return
    for run in runs:
        with watcher.task(f"publishing {run.name}") as progress:
            publishing.catch_up(run, copies, progress)


def _complete(trial: Trial, run: Run, serial: bool, watcher: Watcher, copies: ObjectPath | None) -> None:
    """Train, evaluate and draw what is missing of a trial."""
    baseline = trial.declared.baseline
    if isinstance(baseline, Rival):
        rivals.complete(baseline, trial.config, run, watcher)
        return
    if baseline is not None:
        baselines.complete(baseline, trial.config, run, watcher)
        return
    with watcher.run(trial.config.run.iterations) as observer:
        session.complete(trial.config, run, serial, observer, copies)
    run_figures.draw(run, run_origin.configured(run))


def _evaluated(
    trial: Trial, run: Run, condition: str, overrides: Sequence[str], serial: bool, watcher: Watcher
) -> Evaluation:
    """The evaluation of a trial's policy in the world that the overrides of a condition change."""
    with watcher.run(trial.config.run.iterations) as observer:
        if isinstance(trial.declared.baseline, Baseline):
            return baselines.evaluate(trial.declared.baseline, run, overrides, serial, observer, condition)
        return session.evaluate_newest(run, overrides, serial, observer, condition)


def _finished(root: Path, trial: Trial, conditions: Iterable[str]) -> Finished:
    run = catalog.open_run(root, trial.name)
    as_trained = evaluation.kept(run)
    results = {condition: evaluation.kept(run, condition) for condition in conditions}
    known = {condition: result for condition, result in results.items() if result is not None}
    if as_trained is None or len(known) < len(results):
        raise RunError(f"run {trial.name} lost an evaluation while the study was running; run the study again")
    return Finished(trial, run, as_trained, known, origin(run), tuple(curve.kept(run)))


def _warn_of_other_commits(runs: Sequence[Run], present: str, watcher: Watcher) -> None:
    for run in runs:
        others = [commit for commit in origin(run).commits if commit != present]
        if others:
            watcher.warn(
                f"run {run.name} comes from commit {', '.join(others)}, this is {present}; its data may differ from "
                "what this commit samples (another --root starts afresh)"
            )


class _Pace:
    """The time left: by the estimate until the first part is done, then by the measured pace."""

    def __init__(self, estimate_s: float) -> None:
        self._left_s, self._done_s, self._start = estimate_s, 0.0, time.monotonic()

    def done(self, estimate_s: float) -> None:
        self._left_s -= estimate_s
        self._done_s += estimate_s

    def left_s(self) -> float:
        slower = (time.monotonic() - self._start) / self._done_s if self._done_s else 1.0
        return slower * self._left_s


def estimate_s(planned: Sequence[Trial], conditions_n: int) -> float:
    """Seconds of two idle cores for trials and for the evaluation of each under a number of conditions."""
    total_s = 0.0
    for trial in planned:
        step_s = SECONDS_PER_STEP[trial.config.terrain.difficulty > 0]
        evaluation_s = SECONDS_PER_CONDITION + trial.evaluation_steps * step_s
        total_s += LEARNING_SECONDS_PER_STEP.get(trial.declared.baseline, 0.0) * trial.training_steps
        total_s += SECONDS_PER_RUN + (trial.training_steps + trial.evaluation_steps) * step_s
        total_s += conditions_n * evaluation_s
    return total_s


def _condition_s(trial: Trial) -> float:
    """Seconds of two idle cores for the evaluation of a trial under another condition."""
    return estimate_s([trial], 1) - estimate_s([trial], 0)


def minutes(seconds: float) -> str:
    """A duration for people."""
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
