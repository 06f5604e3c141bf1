"""Speed of the learner on given episodes, measured against straightforward references in the same run.

The references do the same work the plain way: scikit-learn's RANSACRegressor for every mode of a class step, and a
loop over sub-trajectories and time steps in double precision for the backward pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm import backward_pass as lqg
from t6gps.learner.algorithm import local_models as surrogate
from t6gps.learner.algorithm import modes
from t6gps.learner.algorithm.features import Rows, read_rows
from t6gps.learner.algorithm.segments import cut, group
from t6gps.learner.learner import CHUNK, Learner
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.errors import ConfigError, DataError

Array = NDArray[np.float64]

PHASES = {
    "segment": "segment_s",
    "fit": "fit_s",
    "backward_pass": "backward_pass_s",
    "supervise": "supervise_s",
}
BINS, LOOPED = 8, 200
"""Class steps that scikit-learn fits as well, and sub-trajectories that the loop solves as well."""
LARGEST_GAIN_ERROR = 1e-6
TARGET_SPEED_M_PER_S, VERTICAL_WEIGHT = 0.8, 0.1


def measure(
    new_learner: Callable[[], Learner], episodes: Sequence[pa.Table], settings: LearnerSettings
) -> dict[str, float]:
    """Seconds of each phase for `episodes`, in one process, and ratios to the references.

    steps, pairs                       control steps learned from; pairs of the S-step, replayed ones included
    segment_s .. supervise_s           the second of two iterations over the same episodes, so that pairs are replayed
                                       as in a run that goes on
    fit_speedup_over_sklearn           the same BINS class steps, one after the other on one thread
    inlier_share, sklearn_inlier_share of their samples, under the first mode that either finds
    backward_pass_speedup_over_loop    per step: the phase as it runs, against the loop over LOOPED sub-trajectories
    gain_error                         largest difference of K and k from the loop's, in units of its largest gain

    Raises DataError when the two fits find other inliers than those planted in a class step, or when gains differ from
    the loop's by more than LARGEST_GAIN_ERROR.
    """
    result = _phases(new_learner(), episodes, settings)
    tables = {table.column("episode_id")[0].as_py(): table for table in episodes}
    rows = read_rows(tables, settings.reduced_state)
    options = modes.FitOptions(settings.modes, settings.residual_threshold, settings.prior_samples, settings.ridge)
    segments = cut(rows, settings.longest_segment_steps)
    jobs = list(
        surrogate.jobs(rows, segments, group(segments, settings.smallest_class_segments), options, 0, 0).values()
    )
    _check_planted_inliers()
    return result | _fits_against_sklearn(jobs) | _backward_pass_against_loop(jobs, rows, settings, result)


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _phases(learner: Learner, episodes: Sequence[pa.Table], settings: LearnerSettings) -> dict[str, float]:
    for _ in range(2):
        for table in episodes:
            learner.add(table)
        spent = {key: _seconds(partial(list, getattr(learner, phase)())) for phase, key in PHASES.items()}
    steps = sum(table.num_rows - 1 for table in episodes)
    return {"steps": steps, "pairs": steps * (1 + min(settings.replay_iterations, 1)), **spent}


def _fits_against_sklearn(jobs: Sequence[surrogate.ClassJob]) -> dict[str, float]:
    """Both fits of BINS class steps, spread over all of them by size."""
    sizes = {(number, step): n for number, job in enumerate(jobs) for step, n in enumerate(np.bincount(job.step))}
    large = sorted((key for key in sizes if sizes[key] >= modes.SMALLEST_SUBSET), key=lambda key: sizes[key])
    if not large:
        raise DataError(f"no class step has {modes.SMALLEST_SUBSET} samples to compare fits on; give more episodes")
    places = np.linspace(0, len(large) - 1, BINS + 2).round().astype(int)[1:-1]
    chosen = [(jobs[number], step) for number, step in (large[place] for place in places)]
    ours_s = reference_s = 0.0
    samples_n = ours_n = reference_n = 0
    for job, step in chosen:
        samples = job.samples[job.step == step].astype(np.float64)
        prior = job.crossing if job.crosses and step == job.steps - 1 else job.ordinary
        assert prior is not None
        fit = partial(modes.fit_modes, samples, job.state_n, prior, job.options, np.random.default_rng(0))
        ours_s += _seconds(fit)
        first: list[NDArray[np.bool_]] = []
        reference_s += _seconds(lambda: first.extend(sklearn_modes(samples, job.state_n, job.options)))  # noqa: B023
        samples_n, reference_n = samples_n + len(samples), reference_n + int(first[0].sum())
        ours_n += int(_first_mode_inliers(samples, job.state_n, prior, job.options).sum())
    return {
        "fit_speedup_over_sklearn": reference_s / ours_s,
        "inlier_share": ours_n / samples_n,
        "sklearn_inlier_share": reference_n / samples_n,
    }


def _first_mode_inliers(
    samples: Array, state_n: int, prior: modes.Moments, options: modes.FitOptions
) -> NDArray[np.bool_]:
    one = modes.FitOptions(1, options.residual_threshold, options.prior_samples, options.ridge)
    _, _, residual = modes.fit_modes(samples, state_n, prior, one, np.random.default_rng(0))
    return residual < options.residual_threshold


def sklearn_modes(samples: Array, state_n: int, options: modes.FitOptions) -> Iterator[NDArray[np.bool_]]:
    """Inliers [n] of each mode, found one after the other by RANSACRegressor with the same subset size and residual.

    Its other settings are its defaults: 100 trials, and a refit to the inliers of the best.
    """
    try:
        from sklearn.linear_model import LinearRegression, RANSACRegressor
    except ImportError:
        raise ConfigError("`bench learner` compares with scikit-learn; pip install 't6gps[bench]'") from None
    regressor_n = samples.shape[1] - state_n
    z, unit = samples[:, :regressor_n], modes.residual_unit(samples[:, regressor_n:].std(axis=0))
    target = samples[:, regressor_n:] / unit
    subset = max(modes.SMALLEST_SUBSET, int(modes.SUBSET_PER_REGRESSOR * regressor_n))
    remaining = np.arange(len(samples))
    for _ in range(options.modes):
        ransac = RANSACRegressor(
            LinearRegression(),
            min_samples=min(subset, len(remaining)),
            residual_threshold=options.residual_threshold,
            loss=lambda truth, predicted: np.sqrt(((truth - predicted) ** 2).sum(axis=1)),
            random_state=0,
        )
        ransac.fit(z[remaining], target[remaining])
        inliers = np.zeros(len(samples), dtype=bool)
        inliers[remaining[ransac.inlier_mask_]] = True
        yield inliers
        outliers = remaining[~ransac.inlier_mask_]
        if len(outliers) < modes.OUTLIERS_PER_REGRESSOR * regressor_n or len(outliers) == len(remaining):
            return
        remaining = outliers


def _check_planted_inliers() -> None:
    """Both fits must find exactly the inliers of a linear system of the robot's size: 39 states, 24 actions."""
    rng, nx, nu, n = np.random.default_rng(0), 39, 24, 1000
    z = rng.normal(size=(n, nx + nu))
    target = z @ rng.normal(0, 0.3, (nx + nu, nx)) + 0.05 * rng.normal(size=(n, nx))
    planted = rng.permutation(n) >= n // 50
    target[~planted] += rng.normal(0, 5, (n // 50, nx))
    samples = np.hstack([z, target])
    options = modes.FitOptions(1, 0.35, 0.0, 1e-6)
    ours = _first_mode_inliers(samples, nx, modes.moments(samples), options)
    reference = next(sklearn_modes(samples, nx, options))
    if not (np.array_equal(ours, planted) and np.array_equal(reference, planted)):
        raise DataError(
            f"of {planted.sum()} planted inliers the learner finds {(ours & planted).sum()} and scikit-learn "
            f"{(reference & planted).sum()}; the two fits no longer solve the same problem"
        )


def _backward_pass_against_loop(
    jobs: Sequence[surrogate.ClassJob], rows: Rows, settings: LearnerSettings, phases: dict[str, float]
) -> dict[str, float]:
    fits = [surrogate.fit_class(job) for job in jobs]
    patch = surrogate.patch(jobs, fits, len(rows.acts))
    residual = cost.residual(rows.state, rows.target, TARGET_SPEED_M_PER_S, VERTICAL_WEIGHT).astype(np.float64)
    root = cost.root(rows.state.shape[1], VERTICAL_WEIGHT).astype(np.float64)
    gradient, hessian = residual @ root, root.T @ root
    deviation = (rows.action - rows.action_mean).astype(np.float64)
    variance = float(np.nanmean(np.square(deviation)))
    length = settings.horizon_steps
    starts = lqg.sub_trajectories(rows.continues, length)[length][:LOOPED]
    begin, looped = time.perf_counter(), []
    for start in starts:
        steps = start + np.arange(length)
        F, P = patch.models.F[patch.of_row[steps]], patch.models.P[patch.of_row[steps]]
        given = gradient[steps + 1], hessian, deviation[steps]
        looped.append(plain_backward_pass(F, P, variance, settings.kl_weight, *given))
    loop_s = time.perf_counter() - begin
    models, error, largest = lqg.prepare(patch.models, settings.kl_weight, variance), 0.0, 0.0
    for first in range(0, len(starts), CHUNK):
        steps = starts[first : first + CHUNK, None] + np.arange(length)
        found = lqg.backward_pass(models, patch.of_row[steps], residual[steps + 1], root, deviation[steps])
        for number, (K, k, _) in enumerate(looped[first : first + CHUNK]):
            error = max(error, np.abs(found.K[number] - K).max(), np.abs(found.k[number] - k).max())
            largest = max(largest, np.abs(K).max(), np.abs(k).max())
    if error > LARGEST_GAIN_ERROR * largest:
        raise DataError(f"the backward pass and the loop differ by {error / largest:.1e} of the largest gain")
    per_step_s = phases["backward_pass_s"] / np.count_nonzero(rows.continues)
    return {
        "backward_pass_speedup_over_loop": loop_s / (len(starts) * length) / per_step_s,
        "gain_error": float(error / largest),
    }


def plain_backward_pass(
    F: Array, P: Array, variance: float, kl_weight: float, gradient: Array, hessian: Array, deviation: Array
) -> tuple[Any, Any, float]:
    """K [T, nu, nx], k [T, nu] and the predicted change of the cost of one sub-trajectory, by the Riccati recursion.

    gradient [T, nx] and hessian [nx, nx] are those of the running cost; the rest is as in `lqg`.
    """
    length, nx, nu = len(F), F.shape[1], deviation.shape[1]
    K, k = np.zeros((length, nu, nx)), np.zeros((length, nu))
    precision = np.diag(np.full(nu, kl_weight / max(variance, lqg.ACTION_VARIANCE_FLOOR_M2)))
    V, v = hessian, gradient[-1]
    for t in reversed(range(length)):
        Fx, Fu = F[t][:, :nx], F[t][:, nx:]
        Quu = Fu.T @ V @ Fu + precision
        Qux = Fu.T @ V @ Fx - precision @ P[t]
        qu = Fu.T @ v + precision @ deviation[t]
        Qxx = Fx.T @ V @ Fx + P[t].T @ precision @ P[t]
        qx = Fx.T @ v - P[t].T @ precision @ deviation[t]
        K[t], k[t] = -np.linalg.solve(Quu, Qux), -np.linalg.solve(Quu, qu)
        V, v = Qxx + Qux.T @ K[t] + hessian, qx + Qux.T @ k[t] + (gradient[t - 1] if t else 0)
    dx, change = np.zeros(nx), 0.0
    for t in range(length):
        dx = F[t] @ np.concatenate([dx, k[t] + K[t] @ dx])
        change += gradient[t] @ dx + dx @ hessian @ dx / 2
    return K, k, change
