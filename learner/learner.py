"""One iteration of T6-GPS after sampling (paper Algorithm 2, lines 3 to 13), the only stateful part of the learner.

learner.add(frames, noise_std_m)        once per episode, in any order
for done, total in learner.segment():   ...         each phase reports its progress while it runs
for done, total in learner.fit():       ...
for done, total in learner.backward_pass(): ...
for done, total in learner.supervise(): ...         learner.snapshot is now the next policy version

`learner.done` holds what the phases so far have found.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import pyarrow as pa

from t6gps.learner import policy
from t6gps.learner.algorithm import local_models, supervised
from t6gps.learner.algorithm.features import Canonical
from t6gps.learner.algorithm.local_models import ClassJob, ClassModel
from t6gps.learner.algorithm.model_series import patch
from t6gps.learner.algorithm.modes import FitOptions, Search, ransac
from t6gps.learner.algorithm.pairs import Pairs, Several
from t6gps.learner.algorithm.segments import Pieces, classify, group
from t6gps.learner.alternatives import localization, mixtures, standard_gps
from t6gps.learner.checkpoint import Carried
from t6gps.learner.episodes import Episodes, Joined, Reading, RowReading, together
from t6gps.learner.exploration import exploration
from t6gps.learner.improvers import improver, transitions
from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.improvers.improver import Improved, Surrogate
from t6gps.learner.improvers.leading import leading
from t6gps.learner.phases import PHASES
from t6gps.learner.port import LearnerState, Manifest, Progress, Report, Task
from t6gps.learner.report import Fitted, Iteration, Segmented, Trained, kl, report
from t6gps.learner.rows import AnyArray, Floats, Rows
from t6gps.learner.rows import pieces as row_pieces
from t6gps.learner.settings import LearnerSettings, Localization, ModeSearch
from t6gps.learner.streams import Stream, branch, generator
from t6gps.storage import schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.records import PolicySnapshot

FitMap = Callable[[Callable[[ClassJob], ClassModel], Iterable[ClassJob]], Iterator[ClassModel]]
Result = TypeVar("Result")

SEGMENTED = (Localization.SEGMENTS, Localization.TIME)
"""Localizations that fit the models of segment classes; the others leave the table `classes` empty."""
SEARCHES: dict[ModeSearch, Search] = {ModeSearch.RANSAC: ransac, ModeSearch.GAUSSIAN: mixtures.gaussian}
SEEN_N = {"sensors": schema.SENSORS_N, "shape": schema.OBSERVATION_N}
"""Entries of an observation that the policy sees."""


class Learner:
    """Turns the episodes of one iteration into the next policy.

    run_seed        root of all randomness here, with the iteration, which is the policy's version
    fit_map         maps a pure function over jobs as results are asked for, in their order; `map` or a pool
    keeps_earlier   the policy before the newest is kept, too, for workers that act with it in a pipelined run
    """

    def __init__(
        self,
        settings: LearnerSettings,
        task: Task,
        run_seed: int,
        fit_map: FitMap = map,
        keeps_earlier: bool = False,
    ) -> None:
        self._settings, self._task, self._run_seed, self._fit_map = settings, task, run_seed, fit_map
        sizes = SEEN_N[settings.observation], task.world_labels.shape[1], settings.hidden_layers
        first = generator(run_seed, branch(0, Stream.UNTRAINED))
        untrained = policy.initial(*sizes, first, offset_m=task.offset_m, scale_m=task.scale_m)
        self._carried = Carried(untrained, settings.replay_iterations, keeps_earlier)
        self._value: ActionValue | None = None
        if settings.value_from:
            self._value = ActionValue(settings.action_value, *task.cost_weights, self._rng(Stream.ACTION_VALUE))
        in_world = settings.localization is Localization.TIME
        self._rows: RowReading = (
            standard_gps.InWorld(task.world_labels) if in_world else Canonical(settings.reduced_state)
        )
        readings: list[Reading] = [self._rows, *([transitions.Motion(task.mirrored)] if self._value else [])]
        self._episodes = Episodes(readings, settings.longest_segment_steps)
        self._earlier: deque[Joined] = deque(maxlen=settings.action_value.improved_iterations - 1 if self._value else 0)
        self.done = Done()

    def _rng(self, stream: Stream, round_: int = 0) -> np.random.Generator:
        key = branch(self.snapshot.version, stream, *([round_] if round_ else []))
        return generator(self._run_seed, key)

    @property
    def _led_by_value(self) -> bool:
        return self._settings.leads(self.snapshot.version)

    @property
    def snapshot(self) -> PolicySnapshot:
        """The newest policy; its version is the iteration at work."""
        return self._carried.snapshot

    def policy(self, version: int | None = None) -> PolicySnapshot:
        """The policy of a version, the newest by default. Raises RunError when it is not kept."""
        return self._carried.policy(version)

    def add(self, frames: pa.Table, noise_std_m: float) -> None:
        """Take an episode planned with this noise per cable (m): check it, copy what is needed, cut it (line 3).

        Raises DataError when the learner already has it, or when its record is inconsistent.
        """
        episode_id = int(frames.column("episode_id")[0].as_py())
        if episode_id in self._episodes:
            raise DataError(f"episode {episode_id} was added twice in iteration {self.snapshot.version}")
        self._episodes.add(episode_id, frames, {"noise_std_m": noise_std_m})

    def segment(self) -> Progress:
        """Join the segments of all episodes and classify them (lines 3 to 5)."""
        self.done = Done()
        newest = self._episodes.joined()
        if self._value:
            self._value.add(transitions.of_columns(newest.columns, self._task.reach_m))
        known = together([*self._earlier, newest]) if self._led_by_value else newest
        self._earlier.append(newest)
        rows = self._rows.rows(known.columns)
        if self._led_by_value and self._settings.models_share:
            rows = transitions.with_reach(rows, known.columns["rest_lengths"], self._task.reach_m)
        yield 1, 2
        self.done.segmented = _segmented(rows, known.pieces, known.pieces.rows_n - newest.pieces.rows_n, self._settings)
        yield 2, 2

    def fit(self) -> Progress:
        """Fit the local models of every class (lines 4 to 6)."""
        segmented = _of(self.done.segmented, "segment")
        plans = fit_plans(self._settings, segmented, self._run_seed, self.snapshot.version)
        if not plans or not (segmented.rows.continues & segmented.newest).any():
            raise DataError("no transition of this iteration can be learned from: every step ends in a jump")
        jobs = (local_models.job(segmented.rows, plan) for plan in plans.values())
        fits: dict[int, ClassModel] = {}
        for number, fitted in zip(plans, self._fit_map(local_models.fit_class, jobs), strict=True):
            fits[number] = fitted
            yield len(fits), len(plans)
        series = patch(list(plans.values()), list(fits.values()), len(segmented.rows.acts))
        self.done.fitted = Fitted(fits, series)

    def backward_pass(self) -> Progress:
        """Improve the actions along all sub-trajectories (lines 8 to 11)."""
        self.done.improved = yield from self._improve(self.snapshot, 0)

    def _improve(self, snapshot: PolicySnapshot, round_: int) -> Generator[tuple[int, int], None, Improved]:
        rows, series = _of(self.done.segmented, "segment").rows, _of(self.done.fitted, "fit").series
        value, draws = self._value if self._led_by_value else None, partial(self._rng, Stream.ACTION_VALUE, round_)
        surrogate = Surrogate(rows, series, *self._task.cost_weights)
        leads = leading(value, surrogate, snapshot, draws, self._task.command_range_m, self._settings)
        return improver.improve(rows, leads, self._settings.horizon_steps, self._task.command_range_m)

    def supervise(self) -> Progress:
        """Train the policy on this iteration's pairs and the replayed ones (line 13); then let go of the rows.

        Where the action value leads, further rounds each learn it anew for the policy so far, improve and train.
        """
        segmented, fitted = _of(self.done.segmented, "segment"), _of(self.done.fitted, "fit")
        rows, improved, iteration = segmented.rows, _of(self.done.improved, "backward_pass"), self.snapshot.version
        seen, newest, losses = rows.observation[:, : SEEN_N[self._settings.observation]], self.snapshot, []
        for round_ in range(self._settings.rounds if self._led_by_value else 1):
            if round_:
                improved = yield from self._improve(newest, round_)
            pairs = Pairs(seen, _learned(improved, rows), np.flatnonzero(rows.continues))
            rng, all_pairs = self._rng(Stream.SUPERVISED, round_), Several([*self._carried.replayed, pairs])
            newest, loss = yield from supervised.train(newest, all_pairs, self._settings, rng)
            losses.append(loss)
        newest = replace(newest, version=iteration + 1)
        self._carried.advance(newest, pairs)
        divergence = _divergence(newest, segmented, seen, self._task, self._settings.explores_within_reach(iteration))
        trained = Trained(supervised.Loss(losses[0].before, losses[-1].after), divergence)
        results = Iteration(segmented, fitted, improved, trained)
        self.done = Done(report=report(results, iteration, self._task.command_range_m, *self._task.cost_weights))
        if self._value:
            self._value.file_away()

    def report(self) -> Report:
        """What the iteration just finished adds to the tables `iterations` and `classes`."""
        return _of(self.done.report, "supervise")

    def state(self) -> LearnerState:
        """What the next iteration depends on, between two iterations: policies, replayed pairs, the action value."""
        return self._carried.pack(self._value)

    def restore(self, manifest: Manifest, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from `state()`. Raises CheckpointError when entries are missing or the network has another shape."""
        self._carried.unpack(manifest, arrays, self._value)
        self._episodes.clear()
        self._earlier.clear()

    def recall(self, run: Run) -> None:
        """Read from a run's tables what the next iteration depends on beside `state()`: earlier transitions."""
        if self._value is None:
            return
        newest, remembered_n = self.snapshot.version, self._settings.action_value.remembered_iterations
        for iteration in range(max(newest - remembered_n + 1, 0), newest):
            for episode in tables.episodes_of(run, iteration, transitions.COLUMNS):
                self.add(episode.frames, episode.noise_std_m)
            earlier = self._episodes.joined()
            self._value.add(transitions.of_columns(earlier.columns, self._task.reach_m))
            self._value.file_away()
            self._earlier.append(earlier)


@dataclass
class Done:
    """What the phases of the iteration at work have found; after the last one, the report on it."""

    segmented: Segmented | None = None
    fitted: Fitted | None = None
    improved: Improved | None = None
    report: Report | None = None


def _of(result: Result | None, phase: str) -> Result:
    if result is None:
        names = ", ".join(phase.name for phase in PHASES)
        raise RunError(f"{phase}() must come first; an iteration runs {names}")
    return result


def _segmented(rows: Rows, pieces: Pieces, first: int, settings: LearnerSettings) -> Segmented:
    """Rows with their segments and the groups of these; those of the iteration at work begin at row `first`."""
    segments = classify(rows, pieces)
    by_class = settings.localization in SEGMENTED
    return Segmented(rows, segments, group(segments, settings.smallest_class_segments) if by_class else [], first)


def fit_plans(
    settings: LearnerSettings, segmented: Segmented, run_seed: int, iteration: int
) -> dict[int, local_models.ClassPlan]:
    """What is fitted, by the way in which samples are grouped."""
    search = SEARCHES[settings.mode_search]
    options = FitOptions(settings.modes, settings.residual_threshold, settings.prior_samples, settings.ridge, search)
    if settings.localization in SEGMENTED:
        return local_models.plans(segmented.rows, segmented.segments, segmented.groups, options, run_seed, iteration)
    return localization.plans(segmented.rows, settings.localization, options, run_seed, iteration)


def _learned(improved: Improved, rows: Rows) -> Floats:
    """Improved actions in canonical frames [n, nu]."""
    return improved.action if rows.labels is None else standard_gps.to_canonical(improved.action, rows.labels)


def _divergence(snapshot: PolicySnapshot, segmented: Segmented, seen: Floats, task: Task, within_reach: bool) -> Floats:
    """KL divergence of a policy from the one that acted [n] (nat), both with the noise of the row's episode.

    Of the rows of the iteration at work; those of earlier ones have NaN.

    within_reach   the noise departed from what the winches reach of a command
    """
    rows = segmented.rows
    explored, divergence = exploration(rows, rows.acts), np.full(len(rows.acts), np.nan, dtype=np.float32)
    for part in row_pieces(np.flatnonzero(segmented.newest)):
        mean = np.clip(policy.act(snapshot, seen[part]), *task.command_range_m)
        if within_reach:
            mean = schema.reached(mean, seen[part], snapshot.offset_m, task.reach_m)
        if rows.labels is not None:
            mean = standard_gps.to_world(mean, rows.labels[part])
        divergence[part] = kl(rows, part, mean, explored)
    return divergence
