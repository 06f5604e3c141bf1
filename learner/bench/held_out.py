"""How well local models predict episodes that they were not fitted to.

Classes and aligned steps are those of all episodes, as a segment's class is known when it is over. Moments of the
pools and the models are fitted to the other episodes. Where a step has several modes, the prediction is their mean,
weighted by the samples that each explains: which mode a sample belongs to is seen by its outcome alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from t6gps.learner.algorithm import local_models
from t6gps.learner.algorithm.local_models import ClassPlan
from t6gps.learner.learner import fit_plans
from t6gps.learner.report import Segmented
from t6gps.learner.rows import Flags, Floats, Ints, Rows
from t6gps.learner.settings import LearnerSettings


@dataclass(frozen=True)
class HeldOut:
    """Rows [m] of the episodes held out, their next states [m, nx] as they were and as they are predicted.

    known_share   share of the rows held out whose class step has a model: the others are not among the rows
    """

    rows: Ints
    after: Floats
    predicted: Floats
    known_share: float


def held_out(settings: LearnerSettings, segmented: Segmented, run_seed: int, iteration: int, chosen: Flags) -> HeldOut:
    """Fit to the rows that are not `chosen` [n], and predict those that are; whole episodes of an iteration."""
    rows = segmented.rows
    fitted, asked = (
        fit_plans(settings, replace(segmented, rows=_of(rows, part)), run_seed, iteration) for part in (~chosen, chosen)
    )
    by_branch = {plan.branch: plan for plan in fitted.values()}
    parts = [_predicted(rows, plan, by_branch[plan.branch]) for plan in asked.values() if plan.branch in by_branch]
    index, predicted = (np.concatenate(part) for part in zip(*parts, strict=True))
    return HeldOut(index, rows.state[index + 1], predicted, len(index) / int((rows.continues & chosen).sum()))


def _of(rows: Rows, part: Flags) -> Rows:
    """The same rows, of which only a part is sampled."""
    return replace(rows, continues=rows.continues & part)


def _predicted(rows: Rows, asked: ClassPlan, fitted: ClassPlan) -> tuple[Ints, Floats]:
    """Rows [m] of a group whose step has a model, and their predicted next states [m, nx]."""
    fit = local_models.fit_class(local_models.job(rows, fitted))
    samples = np.bincount(fit.model, minlength=len(fit.models))
    first = np.cumsum(fit.modes) - fit.modes
    index, predicted = [], []
    for step in np.unique(asked.step[np.isin(asked.step, fitted.step)]).tolist():
        chosen = asked.rows[asked.step == step]
        z = np.hstack([rows.state[chosen], rows.action[chosen]])
        modes = np.arange(first[step], first[step] + fit.modes[step])
        share = samples[modes] / samples[modes].sum()
        F, f = (np.tensordot(share, array[modes], axes=1) for array in (fit.models.F, fit.models.f))
        index.append(chosen)
        predicted.append((z @ F.T + f).astype(np.float32))
    if not index:
        return np.empty(0, dtype=np.int64), np.empty((0, asked.state_n), dtype=np.float32)
    return np.concatenate(index), np.concatenate(predicted)
