"""What of an iteration goes into the tables `iterations`, `classes` and `models`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm import supervised, warping
from t6gps.learner.algorithm.backward_pass import ACTION_VARIANCE_FLOOR_M2
from t6gps.learner.algorithm.local_models import ClassModel
from t6gps.learner.algorithm.model_series import ModelSeries
from t6gps.learner.algorithm.segments import ClassKey, SegmentGroup, Segments
from t6gps.learner.exploration import Exploration
from t6gps.learner.improvers.improver import Improved
from t6gps.learner.port import Report, Row
from t6gps.learner.rows import NONE, Flags, Floats, Ints, Rows, pieces, root_mean_square
from t6gps.storage.schema import MODELS


@dataclass(frozen=True)
class Segmented:
    """Rows of all episodes [n], their segments, and the groups of segments that share models.

    first   row from which on they are of the iteration at work; those above are of iterations before
    """

    rows: Rows
    segments: Segments
    groups: list[SegmentGroup]
    first: int = 0

    @property
    def newest(self) -> Flags:
        """The row is of the iteration at work [n]."""
        return np.arange(len(self.rows.acts)) >= self.first


@dataclass(frozen=True)
class Fitted:
    """Models of the groups with a dynamics sample, by the group's position, and of each row."""

    fits: dict[int, ClassModel]
    series: ModelSeries


@dataclass(frozen=True)
class Trained:
    """Loss of the S-step, and KL divergence of the new policy from the one that acted [n] (nat)."""

    loss: supervised.Loss
    kl: Floats


@dataclass(frozen=True)
class Iteration:
    """What the phases of an iteration have found."""

    segmented: Segmented
    fitted: Fitted
    improved: Improved
    trained: Trained


def report(
    results: Iteration,
    iteration: int,
    command_range_m: tuple[float, float],
    target_speed_m_per_s: float,
    vertical_weight: float,
) -> Report:
    """The learner's columns of `iterations`, the rows of `classes` and of `models`."""
    rows = results.segmented.rows
    cost_after = np.roll(cost.running_cost(rows.state, rows.target, target_speed_m_per_s, vertical_weight), -1)
    classes = _class_rows(results, cost_after)
    return Report(
        _iteration_row(results, command_range_m),
        [{"iteration": iteration, **row} for row in classes],
        _model_rows(results, iteration),
    )


def kl(rows: Rows, part: Ints, action_mean: Floats, explored: Exploration) -> Floats:
    """KL divergence at rows [m] of a policy with noise-free commands [m, nu] from the one that acted [m] (nat).

    Both have the exploration noise of the row's episode.
    """
    change = action_mean - rows.action_mean[part]
    variance_m2 = np.maximum(explored.variance_m2, ACTION_VARIANCE_FLOOR_M2).astype(np.float32)
    divergence: Floats = np.square(change).sum(axis=1) / (2 * variance_m2[explored.level[part]])
    return divergence


def _iteration_row(results: Iteration, command_range_m: tuple[float, float]) -> Row:
    rows, improved, loss = results.segmented.rows, results.improved, results.trained.loss
    modes = np.concatenate([fit.modes[fit.modes > 0] for fit in results.fitted.fits.values()])
    newest, segments, groups = results.segmented.newest, results.segmented.segments, results.segmented.groups
    sampled = np.flatnonzero(rows.continues & newest)
    return {
        "segments": int(newest[segments.start].sum()),
        "classes": sum(not group.pooled and bool(newest[segments.start[group.segments]].any()) for group in groups),
        "modes": float(modes.mean()),
        "residual": float(np.nanmean(results.fitted.series.residual)),
        "sub_trajectories": improved.sub_trajectories,
        "predicted_cost_change": _mean(improved.predicted_cost_change[sampled]),
        "action_change_m": root_mean_square(sampled, lambda part: improved.action[part] - rows.action_mean[part]),
        "supervised_loss_before": loss.before,
        "supervised_loss": loss.after,
        "policy_kl": _mean(results.trained.kl[rows.acts & newest]),
        "saturated_share": _saturated_share(rows, np.flatnonzero(rows.acts & newest), command_range_m),
    }


def _saturated_share(rows: Rows, acting: Ints, command_range_m: tuple[float, float]) -> float:
    """Share of noise-free commands at an end of the command range, in rows that act [m]."""
    (low, high), saturated_n = np.asarray(command_range_m, dtype=np.float32), 0
    for part in pieces(acting):
        mean = rows.action_mean[part]
        saturated_n += int(((mean <= low) | (mean >= high)).sum())
    return saturated_n / (len(acting) * rows.action_mean.shape[1])


def _class_rows(results: Iteration, cost_after: NDArray[np.floating]) -> list[Row]:
    """The rows of `classes`, without the iteration: classes that have segments of it."""
    newest = results.segmented.newest[results.segmented.segments.start]
    return [
        _class_row(results, cost_after, number, key, members[newest[members]])
        for number, group in enumerate(results.segmented.groups)
        for key, members in group.classes.items()
        if newest[members].any()
    ]


def _class_row(results: Iteration, cost_after: NDArray[np.floating], number: int, key: ClassKey, members: Ints) -> Row:
    """The row of a class: segments `members` of the iteration, in the group of that number."""
    rows, segments = results.segmented.rows, results.segmented.segments
    group, fit = results.segmented.groups[number], results.fitted.fits.get(number)
    lengths = segments.stop - segments.start
    within = np.isin(segments.of_row, members)
    sampled = within & rows.continues
    change = results.improved.predicted_cost_change[sampled]
    return {
        "kind": key.kind,
        "entry_edge": _edge(key.entry),
        "exit_edge": _edge(key.exit),
        "truncated": key.truncated,
        "segments": len(members),
        "rows": int(lengths[members].sum()),
        "time_steps": warping.class_steps(lengths[group.segments], group.key.exit != NONE),
        "pooled": group.pooled,
        "modes": float(fit.modes[fit.modes > 0].mean()) if fit else None,
        "residual": _mean(results.fitted.series.residual[sampled]) if sampled.any() else None,
        "cost": _mean(cost_after[within]),
        "predicted_cost_change": _mean(change) if sampled.any() else None,
        "policy_kl": _mean(results.trained.kl[within]),
    }


def _model_rows(results: Iteration, iteration: int) -> pa.Table:
    """The rows of `models`."""
    groups = dict(enumerate(results.segmented.groups))  # none where samples are not grouped by class
    return pa.concat_tables(
        [_models_of(number, groups.get(number), fit, iteration) for number, fit in results.fitted.fits.items()]
    )


def _models_of(number: int, group: SegmentGroup | None, fit: ClassModel, iteration: int) -> pa.Table:
    """The rows of the models of one bin of samples."""
    models_n = len(fit.models)
    samples = np.bincount(fit.model, minlength=models_n)
    residual = np.bincount(fit.model, fit.residual, models_n) / np.maximum(samples, 1)
    shared: dict[str, int | None] = {"iteration": iteration, "bin": number, **_key(group)}
    columns = {
        **{name: [value] * models_n for name, value in shared.items()},
        "step": np.repeat(np.arange(len(fit.modes)), fit.modes),
        "mode": np.concatenate([np.arange(modes) for modes in fit.modes]),
        "samples": samples,
        "residual": pa.array(residual, mask=samples == 0),
        "dynamics_matrix": _numbers(fit.models.F),
        "dynamics_offset": _numbers(fit.models.f),
        "policy_matrix": _numbers(fit.models.P),
        "policy_offset": _numbers(fit.models.p),
        "action_variance": _numbers(fit.models.variance),
    }
    return pa.table([pa.array(columns[field.name], field.type) for field in MODELS], schema=MODELS)


def _key(group: SegmentGroup | None) -> dict[str, int | None]:
    """Columns of a group's class, all None for a bin of other samples."""
    if group is None:
        return dict.fromkeys(("kind", "entry_edge", "exit_edge", "truncated", "pooled"))
    kind, entry, exit_, truncated = group.key
    return {
        "kind": kind,
        "entry_edge": _edge(entry),
        "exit_edge": _edge(exit_),
        "truncated": truncated,
        "pooled": group.pooled,
    }


def _numbers(arrays: Floats | NDArray[np.float64]) -> pa.Array:
    """A list of numbers for each of k arrays [k, ...]."""
    flat = np.ascontiguousarray(arrays, dtype=np.float32).reshape(-1)
    return pa.ListArray.from_arrays(np.arange(len(arrays) + 1, dtype=np.int32) * arrays[0].size, pa.array(flat))


def _edge(number: int) -> int | None:
    """The number of an edge, None where there is none."""
    return None if number == NONE else number


def _mean(values: NDArray[np.floating]) -> float:
    return float(values.mean(dtype=np.float64))
