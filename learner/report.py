"""What each phase of an iteration leaves behind, and what of it goes into the tables `iterations` and `classes`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t6gps.learner import cost
from t6gps.learner.algorithm import backward_pass as lqg
from t6gps.learner.algorithm import local_models as surrogate
from t6gps.learner.algorithm import supervised, warping
from t6gps.learner.algorithm.features import NONE, Rows
from t6gps.learner.algorithm.segments import SegmentGroup, Segments


@dataclass(frozen=True)
class Segmented:
    """Rows of all episodes [n], their segments, and the groups of segments that share models."""

    rows: Rows
    segments: Segments
    groups: list[SegmentGroup]


@dataclass(frozen=True)
class Fitted:
    """Models of the groups with a dynamics sample, by the group's position, and of each row."""

    fits: dict[int, surrogate.ClassModel]
    patch: surrogate.Patch


@dataclass(frozen=True)
class Improved:
    """Improved actions [n, nu] and the predicted change of the running cost that follows [n]; NaN without a sample."""

    action: NDArray[np.float32]
    predicted_cost_change: NDArray[np.float32]
    sub_trajectories: int


@dataclass(frozen=True)
class Trained:
    """Loss of the S-step and the commands of the new policy at every row [n, nu], without noise (m)."""

    loss: supervised.Loss
    action_mean: NDArray[np.float32]


def iteration_row(
    segmented: Segmented, fitted: Fitted, improved: Improved, trained: Trained, command_range_m: tuple[float, float]
) -> dict[str, Any]:
    """The learner's columns of `iterations`."""
    rows = segmented.rows
    modes = np.concatenate([fit.modes[fit.modes > 0] for fit in fitted.fits.values()])
    mean, (low, high) = rows.action_mean[rows.acts], np.asarray(command_range_m, dtype=np.float32)
    return {
        "segments": len(segmented.segments.start),
        "classes": sum(not group.pooled for group in segmented.groups),
        "modes": float(modes.mean()),
        "residual": float(np.nanmean(fitted.patch.residual)),
        "sub_trajectories": improved.sub_trajectories,
        "predicted_cost_change": _mean(improved.predicted_cost_change[rows.continues]),
        "action_change_m": root_mean_square((improved.action - rows.action_mean)[rows.continues]),
        "supervised_loss_before": trained.loss.before,
        "supervised_loss": trained.loss.after,
        "policy_kl": _mean(_kl(rows, trained)[rows.acts]),
        "saturated_share": float(((mean <= low) | (mean >= high)).mean()),
    }


def class_rows(
    segmented: Segmented,
    fitted: Fitted,
    improved: Improved,
    trained: Trained,
    target_speed_m_per_s: float,
    vertical_weight: float,
) -> list[dict[str, Any]]:
    """The rows of `classes`, without the iteration."""
    rows, segments = segmented.rows, segmented.segments
    lengths, kl, found = segments.stop - segments.start, _kl(rows, trained), []
    cost_after = np.roll(cost.running_cost(rows.state, rows.target, target_speed_m_per_s, vertical_weight), -1)
    for number, group in enumerate(segmented.groups):
        fit = fitted.fits.get(number)
        for key, members in group.classes.items():
            own = np.isin(segments.of_row, members)
            sampled = own & rows.continues
            found.append(
                {
                    "kind": key.kind,
                    "entry_edge": None if key.entry == NONE else key.entry,
                    "exit_edge": None if key.exit == NONE else key.exit,
                    "truncated": key.truncated,
                    "segments": len(members),
                    "rows": int(lengths[members].sum()),
                    "time_steps": warping.class_steps(lengths[group.segments], group.key.exit != NONE),
                    "pooled": group.pooled,
                    "modes": float(fit.modes[fit.modes > 0].mean()) if fit else 0.0,
                    "residual": _mean(fitted.patch.residual[sampled]) if sampled.any() else 0.0,
                    "cost": _mean(cost_after[own]),
                    "predicted_cost_change": _mean(improved.predicted_cost_change[sampled]) if sampled.any() else None,
                    "policy_kl": _mean(kl[own]),
                }
            )
    return found


def _kl(rows: Rows, trained: Trained) -> NDArray[np.float32]:
    """KL divergence of the new policy from the one that acted, both with the exploration variance [n] (nat)."""
    variance = root_mean_square((rows.action - rows.action_mean)[rows.acts]) ** 2
    change = trained.action_mean - rows.action_mean
    divergence: NDArray[np.float32] = np.square(change).sum(axis=1) / (2 * max(variance, lqg.ACTION_VARIANCE_FLOOR_M2))
    return divergence


def root_mean_square(values: NDArray[np.float32]) -> float:
    """Root of the mean square of all entries."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _mean(values: NDArray[np.floating]) -> float:
    return float(values.mean(dtype=np.float64))
