"""One iteration of T6-GPS after sampling (paper Algorithm 2, lines 3 to 13), the only stateful part of the learner.

learner.add(frames)                     once per episode, in any order
for done, total in learner.segment():   ...         each phase reports its progress while it runs
for done, total in learner.fit():       ...
for done, total in learner.backward_pass(): ...
for done, total in learner.supervise(): ...         learner.snapshot is now the next policy version
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner import cost, policy, report
from t6gps.learner.algorithm import backward_pass as lqg
from t6gps.learner.algorithm import local_models as surrogate
from t6gps.learner.algorithm import supervised
from t6gps.learner.algorithm.features import Rows, read_rows
from t6gps.learner.algorithm.modes import FitOptions
from t6gps.learner.algorithm.segments import cut, group
from t6gps.learner.alternatives import localization, standard_gps
from t6gps.learner.improvers import action_value as value
from t6gps.learner.report import Fitted, Improved, Segmented, Trained, root_mean_square
from t6gps.learner.settings import LearnerSettings, Localization
from t6gps.storage import schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import CheckpointError, DataError, RunError
from t6gps.storage.records import PolicySnapshot

FitMap = Callable[
    [Callable[[surrogate.ClassJob], surrogate.ClassModel], Sequence[surrogate.ClassJob]],
    Iterator[surrogate.ClassModel],
]
Pairs = tuple[NDArray[np.float32], NDArray[np.float32]]
Phase = TypeVar("Phase")

LEARNER_STREAM, SUPERVISED_STREAM, INITIAL_STREAM, VALUE_STREAM = 1, 1, 2, 3
"""Branches of the run's seed sequence: (1, iteration, 0 fits | 1 S-step | 2 untrained policy | 3 action value)."""
SEGMENTED = (Localization.SEGMENTS, Localization.TIME)
"""Localizations that fit the models of segment classes; the others leave the table `classes` empty."""
SEEN_N = {"sensors": schema.SENSORS_N, "shape": schema.OBSERVATION_N}
"""Entries of an observation that the policy sees."""
CHUNK = 64
"""Sub-trajectories solved at once: their results stay in the cache. Chunks do not depend on each other, so they run on
all cores, which the workers leave idle while the learner works (but for a pipelined run), with the same result."""


class Learner:
    """Turns the episodes of one iteration into the next policy.

    run_seed               root of all randomness here, with the iteration, which is the policy's version
    target_speed_m_per_s   v* of the cost
    vertical_weight        weight of the vertical velocity in the cost
    command_range_m        improved actions are clipped to it
    offset_m, scale_m      u = offset + scale * network
    reach_m                farthest that a winch comes in a control step
    world_labels           canonical label of each world label of an action, by symmetry element [elements, nu]
    mirrored               the symmetry element mirrors the world [elements]
    fit_map                applies a pure function to jobs and returns the results in their order; `map` or a
                           pool
    keeps_earlier          the policy before the newest is kept, too, for workers that act with it in a pipelined run
    """

    def __init__(
        self,
        settings: LearnerSettings,
        *,
        run_seed: int,
        target_speed_m_per_s: float,
        vertical_weight: float,
        command_range_m: tuple[float, float],
        offset_m: float,
        scale_m: float,
        reach_m: float,
        world_labels: NDArray[np.int64],
        mirrored: NDArray[np.bool_],
        fit_map: FitMap = map,
        keeps_earlier: bool = False,
    ) -> None:
        self._settings = settings
        self._run_seed = run_seed
        self._target_speed_m_per_s = target_speed_m_per_s
        self._vertical_weight = vertical_weight
        self._command_range_m, self._reach_m = command_range_m, reach_m
        self._world_labels, self._mirrored = world_labels, mirrored
        self._fit_map = fit_map
        self._keeps_earlier = keeps_earlier
        action_n = schema.vector_length(schema.FRAMES.field("action"))
        assert action_n is not None
        self.snapshot: PolicySnapshot = policy.initial(
            SEEN_N[settings.observation],
            action_n,
            settings.hidden_layers,
            self._rng(0, INITIAL_STREAM),
            offset_m=offset_m,
            scale_m=scale_m,
        )
        self._earlier: PolicySnapshot | None = None
        self._value: value.ActionValue | None = None
        if settings.value_from:
            weights = target_speed_m_per_s, vertical_weight
            self._value = value.ActionValue(reach_m, *weights, self._rng(0, VALUE_STREAM))
        self._replayed: deque[Pairs] = deque(maxlen=settings.replay_iterations)
        self._episodes: dict[int, pa.Table] = {}
        self._segmented: Segmented | None = None
        self._fitted: Fitted | None = None
        self._improved: Improved | None = None
        self._trained: Trained | None = None

    def _rng(self, iteration: int, stream: int) -> np.random.Generator:
        branch = (LEARNER_STREAM, iteration, stream)
        return np.random.default_rng(np.random.SeedSequence(self._run_seed, spawn_key=branch))

    def policy(self, version: int | None = None) -> PolicySnapshot:
        """The policy of a version, the newest by default. Raises RunError when it is not kept."""
        for kept in (self.snapshot, self._earlier):
            if kept is not None and version in (None, kept.version):
                return kept
        raise RunError(
            f"policy version {version} is not kept, the learner has come to version {self.snapshot.version}; "
            "only run.pipelined keeps the one before"
        )

    def add(self, frames: pa.Table) -> None:
        """Take one episode of the iteration. Raises DataError when the learner already has it."""
        episode_id = frames.column("episode_id")[0].as_py()
        if episode_id in self._episodes:
            raise DataError(f"episode {episode_id} was added twice in iteration {self.snapshot.version}")
        self._episodes[episode_id] = frames

    def segment(self) -> Iterator[tuple[int, int]]:
        """Cut the episodes into segments and classify them (lines 3 to 5); the learner lets go of their tables."""
        if self._settings.localization is Localization.TIME:
            rows = standard_gps.read_rows(self._episodes, self._world_labels)
        else:
            rows = read_rows(self._episodes, self._settings.reduced_state)
        if self._value:
            self._value.add(value.read(self._episodes, self._mirrored, self._reach_m))
        self._episodes.clear()
        self._fitted = self._improved = self._trained = None
        yield 1, 2
        segments = cut(rows, self._settings.longest_segment_steps)
        segmented = self._settings.localization in SEGMENTED
        groups = group(segments, self._settings.smallest_class_segments) if segmented else []
        self._segmented = Segmented(rows, segments, groups)
        yield 2, 2

    def fit(self) -> Iterator[tuple[int, int]]:
        """Fit the local models of every class (line 6)."""
        data = _of(self._segmented, "segment")
        settings = self._settings
        options = FitOptions(
            settings.modes, settings.residual_threshold, settings.prior_samples, settings.ridge, settings.mode_search
        )
        seeds = self._run_seed, self.snapshot.version
        if settings.localization in SEGMENTED:
            jobs = surrogate.jobs(data.rows, data.segments, data.groups, options, *seeds)
        else:
            jobs = localization.jobs(data.rows, settings.localization, options, *seeds)
        if not jobs:
            raise DataError("no transition of this iteration can be learned from: every step ends in a jump")
        fits = {}
        for number, fitted in zip(jobs, self._fit_map(surrogate.fit_class, list(jobs.values())), strict=True):
            fits[number] = fitted
            yield len(fits), len(jobs)
        patch = surrogate.patch(list(jobs.values()), list(fits.values()), len(data.rows.acts))
        self._fitted = Fitted(fits, patch)

    def backward_pass(self) -> Iterator[tuple[int, int]]:
        """Improve the actions along all sub-trajectories (lines 8 to 11), or by the action value where that leads."""
        rows, patch = _of(self._segmented, "segment").rows, _of(self._fitted, "fit").patch
        settings = self._settings
        weights = self._target_speed_m_per_s, self._vertical_weight
        residual = cost.residual(rows.state, rows.target, *weights)
        root = cost.root(rows.state.shape[1], self._vertical_weight)
        improved, predicted = np.full_like(rows.action, np.nan), np.full(len(rows.acts), np.nan, dtype=np.float32)
        chunks = [
            starts[first : first + CHUNK, None] + np.arange(length)
            for length, starts in lqg.sub_trajectories(rows.continues, settings.horizon_steps).items()
            for first in range(0, len(starts), CHUNK)
        ]
        leading = self._value if self.snapshot.version >= settings.value_from else None
        sub_trajectories_n = sum(map(len, chunks))
        done, total = 0, sub_trajectories_n + (leading.steps_n if leading else 0)
        if leading:
            for _ in leading.learn(self.snapshot, self._rng(self.snapshot.version, VALUE_STREAM)):
                done += 1
                yield done, total
            climbed = np.clip(leading.improved(self.snapshot), *self._command_range_m)
            F = patch.models.F.astype(np.float32)

            def improve(steps: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[Any]]:
                k = climbed[steps] - rows.action[steps]
                return k, lqg.predicted_change(F, patch.of_row[steps], residual[steps + 1], root, k)

        else:
            deviation, variance = self._deviation(rows, patch)
            models = lqg.prepare(patch.models, settings.kl_weight, variance)

            def improve(steps: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[Any]]:
                found = lqg.backward_pass(models, patch.of_row[steps], residual[steps + 1], root, deviation[steps])
                return found.k, found.predicted_cost_change

        with ThreadPoolExecutor(os.cpu_count()) as threads:
            for steps, (k, change) in zip(chunks, threads.map(improve, chunks), strict=True):
                improved[steps], predicted[steps] = rows.action[steps] + k, change
                done += len(steps)
                yield done, total
        improved = np.clip(improved, *self._command_range_m).astype(np.float32)
        self._improved = Improved(improved, predicted, sub_trajectories_n)

    def _deviation(self, rows: Rows, patch: surrogate.Patch) -> tuple[NDArray[np.float32], float | None]:
        """Recorded action minus policy mean [n, nu], and the exploration variance if it is to replace the fitted S."""
        deviation = rows.action - rows.action_mean
        if self._settings.deviation_from == "recorded":
            return deviation, root_mean_square(deviation[rows.continues]) ** 2
        P, p = (array.astype(np.float32) for array in (patch.models.P, patch.models.p))
        for model in np.unique(patch.of_row[rows.continues]):
            chosen = np.flatnonzero(patch.of_row == model)
            deviation[chosen] = rows.action[chosen] - rows.state[chosen] @ P[model].T - p[model]
        return deviation, None

    def supervise(self) -> Iterator[tuple[int, int]]:
        """Train the policy on this iteration's pairs and the replayed ones (line 13)."""
        rows, improved = _of(self._segmented, "segment").rows, _of(self._improved, "backward_pass")
        learned = improved.action if rows.labels is None else standard_gps.to_canonical(improved.action, rows.labels)
        seen = rows.observation[:, : SEEN_N[self._settings.observation]]
        pairs = seen[rows.continues], learned[rows.continues]
        observations, actions = (np.concatenate(part) for part in zip(*self._replayed, pairs, strict=True))
        rng = self._rng(self.snapshot.version, SUPERVISED_STREAM)
        training = supervised.train(self.snapshot, observations, actions, self._settings, rng)
        newest, loss = yield from training
        self._earlier, self.snapshot = self.snapshot if self._keeps_earlier else None, newest
        self._replayed.append(pairs)
        mean = np.clip(policy.act(self.snapshot, seen), *self._command_range_m)
        if rows.labels is not None:
            mean = standard_gps.to_world(mean, rows.labels)
        self._trained = Trained(loss, mean)

    def report(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """The learner's columns of `iterations` and the rows of `classes` of the iteration just finished."""
        segmented, fitted = _of(self._segmented, "segment"), _of(self._fitted, "fit")
        improved, trained = _of(self._improved, "backward_pass"), _of(self._trained, "supervise")
        iteration = report.iteration_row(segmented, fitted, improved, trained, self._command_range_m)
        weights = self._target_speed_m_per_s, self._vertical_weight
        classes = report.class_rows(segmented, fitted, improved, trained, *weights)
        number = {"iteration": self.snapshot.version - 1}
        return iteration, [number | row for row in classes]

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """What the next iteration depends on, between two iterations: policies, replayed pairs, the action value."""
        arrays = _arrays(self.snapshot, "layer")
        if self._earlier is not None:
            arrays |= _arrays(self._earlier, "earlier_layer")
        for number, (observations, actions) in enumerate(self._replayed):
            arrays[f"replay_{number}_observations"], arrays[f"replay_{number}_actions"] = observations, actions
        if self._value:
            arrays |= self._value.arrays()
        manifest = {
            "version": self.snapshot.version,
            "offset_m": self.snapshot.offset_m,
            "scale_m": self.snapshot.scale_m,
            "layers": len(self.snapshot.layers),
            "replays": len(self._replayed),
        }
        return manifest, arrays

    def restore(self, manifest: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from `state()`. Raises CheckpointError when entries are missing or the network has another shape."""
        try:
            restored = _policy(manifest, arrays, "layer", manifest["version"])
            earlier = None
            if self._keeps_earlier and restored.version > 0:
                earlier = _policy(manifest, arrays, "earlier_layer", restored.version - 1)
            replayed = [
                (arrays[f"replay_{number}_observations"], arrays[f"replay_{number}_actions"])
                for number in range(manifest["replays"])
            ]
            if self._value:
                self._value.restore(arrays)
        except KeyError as error:
            raise CheckpointError(f"the learner's checkpoint lacks {error}; use an older checkpoint") from error
        found = [weight.shape for weight, _ in restored.layers]
        expected = [weight.shape for weight, _ in self.snapshot.layers]
        if found != expected:
            raise CheckpointError(
                f"the checkpoint's policy has layers {found}, the settings ask for {expected}; "
                "set hidden_layers as in the run that wrote it"
            )
        self.snapshot, self._earlier = restored, earlier
        self._replayed = deque(replayed, maxlen=self._settings.replay_iterations)
        self._episodes.clear()

    def recall(self, run: Run) -> None:
        """Read from a run's tables what the next iteration depends on beside `state()`: earlier transitions."""
        if self._value is None:
            return
        newest = self.snapshot.version
        for iteration in range(max(newest - value.REMEMBERED_N + 1, 0), newest):
            episodes = tables.frames_of(run, iteration, value.COLUMNS)
            self._value.add(value.read(episodes, self._mirrored, self._reach_m))


def _arrays(snapshot: PolicySnapshot, name: str) -> dict[str, NDArray[Any]]:
    """The layers of a policy under the names that a checkpoint has for them."""
    arrays: dict[str, NDArray[Any]] = {}
    for number, (weight, bias) in enumerate(snapshot.layers):
        arrays[f"{name}_{number}_weight"], arrays[f"{name}_{number}_bias"] = weight, bias
    return arrays


def _policy(manifest: dict[str, Any], arrays: dict[str, NDArray[Any]], name: str, version: int) -> PolicySnapshot:
    """The policy of which `_arrays` has made these layers. KeyError when one is missing."""
    layers = tuple(
        (arrays[f"{name}_{number}_weight"], arrays[f"{name}_{number}_bias"]) for number in range(manifest["layers"])
    )
    return PolicySnapshot(version, layers, manifest["offset_m"], manifest["scale_m"])


def _of(result: Phase | None, phase: str) -> Phase:
    if result is None:
        raise RunError(f"{phase}() must come first; an iteration runs segment, fit, backward_pass, supervise")
    return result
