"""Speed of the learner on given episodes, measured against straightforward references in the same run.

The references do the same work the plain way (`references`): scikit-learn's RANSACRegressor for every mode of a class
step, and a loop over sub-trajectories and time steps in double precision for the backward pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pyarrow as pa

from t6gps.learner import cost
from t6gps.learner.algorithm import backward_pass, local_models, model_series, modes
from t6gps.learner.algorithm.features import Canonical
from t6gps.learner.algorithm.local_models import ClassPlan
from t6gps.learner.algorithm.regression import Array, Moments, moments
from t6gps.learner.algorithm.segments import classify, group
from t6gps.learner.algorithm.sub_trajectories import CHUNK, sub_trajectories
from t6gps.learner.bench.references import Gains, plain_backward_pass, sklearn_modes
from t6gps.learner.episodes import Episodes
from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.rows import Flags, Rows
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.errors import DataError

BINS = 8
"""Class steps that scikit-learn fits as well."""
LOOPED = 200
"""Sub-trajectories that the loop solves as well."""
LARGEST_GAIN_ERROR = 1e-6
NOISE_STD_M = 0.15
"""All episodes count as explored alike: no duration depends on it."""
TARGET_SPEED_M_PER_S = 0.8
VERTICAL_WEIGHT = 0.1


def measure(
    new_learner: Callable[[], Learner], episodes: Sequence[pa.Table], settings: LearnerSettings
) -> dict[str, float]:
    """Seconds of each phase for `episodes`, in one process, and ratios to the references.

    steps, pairs                       control steps learned from; pairs of the S-step, replayed ones included
    segment_s .. supervise_s           the second of two iterations over the same episodes, so that pairs are replayed
                                       as in a run that continues
    fit_speedup_over_sklearn           the same BINS class steps, one after the other on one thread
    inlier_share, sklearn_inlier_share of their samples, under the first mode that either finds
    backward_pass_speedup_over_loop    per step: the phase as it runs, against the loop over LOOPED sub-trajectories
    gain_error                         largest difference of K and k from the loop's, in units of its largest gain

    Raises DataError when the two fits find other inliers than those planted in a class step, or when gains differ from
    the loop's by more than LARGEST_GAIN_ERROR.
    """
    result = _phases(new_learner(), episodes, settings)
    reading = Canonical(settings.reduced_state)
    taken = Episodes([reading], settings.longest_segment_steps)
    for table in episodes:
        taken.add(table.column("episode_id")[0].as_py(), table, {"noise_std_m": NOISE_STD_M})
    columns, pieces = taken.joined()
    rows = reading.rows(columns)
    options = modes.FitOptions(settings.modes, settings.residual_threshold, settings.prior_samples, settings.ridge)
    segments = classify(rows, pieces)
    groups = group(segments, settings.smallest_class_segments)
    plans = list(local_models.plans(rows, segments, groups, options, 0, 0).values())
    check_planted_inliers(first_mode_inliers)
    loop = _backward_pass_against_loop(plans, rows, settings, result["backward_pass_s"])
    return result | _fits_against_sklearn(plans, rows) | loop


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _phases(learner: Learner, episodes: Sequence[pa.Table], settings: LearnerSettings) -> dict[str, float]:
    for _ in range(2):
        for table in episodes:
            learner.add(table, NOISE_STD_M)
        spent = {f"{phase.name}_s": _seconds(partial(list, getattr(learner, phase.name)())) for phase in PHASES}
    steps = sum(table.num_rows - 1 for table in episodes)
    return {"steps": steps, "pairs": steps * (1 + min(settings.replay_iterations, 1)), **spent}


@dataclass(frozen=True)
class ClassStep:
    """Samples of a class step, and what is needed to fit them."""

    samples: Array
    state_n: int
    prior: Moments
    options: modes.FitOptions


def _class_steps(plans: Sequence[ClassPlan], rows: Rows) -> list[ClassStep]:
    """BINS class steps, spread over all of them by size."""
    sizes = {(number, step): n for number, plan in enumerate(plans) for step, n in enumerate(np.bincount(plan.step))}
    large = sorted((key for key in sizes if sizes[key] >= modes.SMALLEST_SUBSET), key=lambda key: sizes[key])
    if not large:
        raise DataError(f"no class step has {modes.SMALLEST_SUBSET} samples to compare fits on; give more episodes")
    places = np.linspace(0, len(large) - 1, BINS + 2).round().astype(int)[1:-1]
    chosen = []
    for number, step in (large[place] for place in places):
        plan = plans[number]
        prior = plan.crossing if plan.crosses and step == plan.steps - 1 else plan.ordinary
        assert prior is not None
        samples = rows.samples(plan.rows[plan.step == step]).astype(np.float64)
        chosen.append(ClassStep(samples, plan.state_n, prior, plan.options))
    return chosen


def _fits_against_sklearn(plans: Sequence[ClassPlan], rows: Rows) -> dict[str, float]:
    """Both fits of BINS class steps."""
    ours_s = reference_s = 0.0
    samples_n = ours_n = reference_n = 0
    for step in _class_steps(plans, rows):
        rng, first = np.random.default_rng(0), list[Flags]()
        ours_s += _seconds(partial(modes.fit_modes, step.samples, step.state_n, step.prior, step.options, rng))
        inliers = sklearn_modes(step.samples, step.state_n, step.options)
        reference_s += _seconds(partial(first.extend, inliers))
        samples_n, reference_n = samples_n + len(step.samples), reference_n + int(first[0].sum())
        ours_n += int(first_mode_inliers(step).sum())
    return {
        "fit_speedup_over_sklearn": reference_s / ours_s,
        "inlier_share": ours_n / samples_n,
        "sklearn_inlier_share": reference_n / samples_n,
    }


def first_mode_inliers(step: ClassStep) -> Flags:
    """Samples [n] that the first mode explains."""
    options = replace(step.options, modes=1)
    _, _, residual = modes.fit_modes(step.samples, step.state_n, step.prior, options, np.random.default_rng(0))
    return residual < options.residual_threshold


def check_planted_inliers(fit: Callable[[ClassStep], Flags]) -> None:
    """Both fits must find exactly the inliers of a linear system of the robot's size: 39 states, 24 actions."""
    rng, nx, nu, n = np.random.default_rng(0), 39, 24, 1000
    z = rng.normal(size=(n, nx + nu))
    target = z @ rng.normal(0, 0.3, (nx + nu, nx)) + 0.05 * rng.normal(size=(n, nx))
    planted = rng.permutation(n) >= n // 50
    target[~planted] += rng.normal(0, 5, (n // 50, nx))
    samples = np.hstack([z, target])
    options = modes.FitOptions(1, 0.35, 0.0, 1e-6)
    ours = fit(ClassStep(samples, nx, moments(samples), options))
    reference = next(sklearn_modes(samples, nx, options))
    if not (np.array_equal(ours, planted) and np.array_equal(reference, planted)):
        raise DataError(
            f"of {planted.sum()} planted inliers the learner finds {(ours & planted).sum()} and scikit-learn "
            f"{(reference & planted).sum()}; the two fits no longer solve the same problem"
        )


def _backward_pass_against_loop(
    plans: Sequence[ClassPlan], rows: Rows, settings: LearnerSettings, backward_pass_s: float
) -> dict[str, float]:
    """The backward pass against the loop over LOOPED sub-trajectories, in speed and in gains."""
    fits = [local_models.fit_class(local_models.job(rows, plan)) for plan in plans]
    series = model_series.patch(plans, fits, len(rows.acts))
    residual = cost.residual(rows.state, rows.target, TARGET_SPEED_M_PER_S, VERTICAL_WEIGHT).astype(np.float64)
    root = cost.root(rows.state.shape[1], VERTICAL_WEIGHT).astype(np.float64)
    deviation = rows.action - rows.action_mean
    variance = float(np.nanmean(np.square(deviation, dtype=np.float64)))
    length = settings.horizon_steps
    starts = sub_trajectories(rows.continues, length)[length][:LOOPED]
    begin, looped = time.perf_counter(), list[Gains]()
    for start in starts:
        steps = start + np.arange(length)
        F, P = series.models.F[series.of_row[steps]], series.models.P[series.of_row[steps]]
        around = residual[steps + 1] @ root, root.T @ root, deviation[steps].astype(np.float64)
        looped.append(plain_backward_pass(F, P, variance, settings.kl_weight, *around))
    loop_s = time.perf_counter() - begin
    models, error, largest = backward_pass.prepare(series.models, settings.kl_weight, variance), 0.0, 0.0
    for first in range(0, len(starts), CHUNK):
        steps = starts[first : first + CHUNK, None] + np.arange(length)
        improvement = backward_pass.backward_pass(
            models, series.of_row[steps], residual[steps + 1], root, deviation[steps]
        )
        error, largest = _worst(improvement, looped[first:], error, largest)
    if error > LARGEST_GAIN_ERROR * largest:
        raise DataError(f"the backward pass and the loop differ by {error / largest:.1e} of the largest gain")
    per_step_s = backward_pass_s / np.count_nonzero(rows.continues)
    return {
        "backward_pass_speedup_over_loop": loop_s / (len(starts) * length) / per_step_s,
        "gain_error": float(error / largest),
    }


def _worst(
    improvement: backward_pass.Improvement, looped: Sequence[Gains], error: float, largest: float
) -> tuple[float, float]:
    """The largest difference of the gains so far, and the largest gain."""
    for ours_K, ours_k, (K, k, _) in zip(improvement.K, improvement.k, looped, strict=False):
        error = max(error, float(np.abs(ours_K - K).max()), float(np.abs(ours_k - k).max()))
        largest = max(largest, float(np.abs(K).max()), float(np.abs(k).max()))
    return error, largest
