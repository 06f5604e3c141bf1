"""The model of each row: series of models along trajectories (PatchModelSeries; Algorithm 2, line 9).

Every row with a dynamics sample lies in one bin of one class, so a series of models along any sub-trajectory is a table
look-up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.local_models import ClassModel, ClassPlan
from t6gps.learner.algorithm.regression import Models, stack
from t6gps.learner.rows import NONE, Ints


@dataclass(frozen=True)
class ModelSeries:
    """The models of all groups and the one that belongs to each row [n], NONE without a dynamics sample."""

    models: Models
    of_row: Ints
    residual: NDArray[np.float64]


def patch(plans: Sequence[ClassPlan], fits: Sequence[ClassModel], rows_n: int) -> ModelSeries:
    """Models of all groups in one table, and each row's model in it (PatchModelSeries of Algorithm 2)."""
    of_row, residual = np.full(rows_n, NONE), np.full(rows_n, np.nan)
    first = 0
    for plan, fit in zip(plans, fits, strict=True):
        of_row[plan.rows], residual[plan.rows] = first + fit.model, fit.residual
        first += len(fit.models)
    return ModelSeries(stack([fit.models for fit in fits]), of_row, residual)
