"""Actions improved by the backward pass through the local models (Algorithm 2, lines 9 and 10)."""

from __future__ import annotations

import numpy as np

from t6gps.learner.algorithm import backward_pass
from t6gps.learner.algorithm.backward_pass import LqgModels
from t6gps.learner.algorithm.model_series import ModelSeries
from t6gps.learner.exploration import exploration
from t6gps.learner.improvers.improver import Change, Improver, Surrogate
from t6gps.learner.rows import NONE, Floats, Ints, Rows
from t6gps.learner.settings import LearnerSettings


class ByBackwardPass(Improver):
    """u* = u + k at the recorded states, with the S of each episode, or that of the fitted policy."""

    def __init__(self, surrogate: Surrogate, settings: LearnerSettings) -> None:
        rows, series = surrogate.rows, surrogate.series
        self._surrogate, self._fitted = surrogate, None
        self._level: Ints = np.zeros(len(rows.acts), dtype=np.int64)
        variances: tuple[float | None, ...] = (None,)
        if settings.deviation_from == "fitted":
            self._fitted = _fitted_deviation(rows, series)
        else:
            explored = exploration(rows, rows.continues)
            variances, self._level = explored.variance_m2, explored.level
        self._models = [backward_pass.prepare(series.models, settings.kl_weight, variance) for variance in variances]

    def improve(self, steps: Ints) -> Change:
        """As `backward_pass.backward_pass` does; a sub-trajectory lies within one episode."""
        k = np.empty((*steps.shape, self._surrogate.rows.action.shape[1]), dtype=np.float32)
        predicted, level = np.empty(steps.shape, dtype=np.float32), self._level[steps[:, 0]]
        for number in np.unique(level).tolist():
            chosen = np.flatnonzero(level == number)
            k[chosen], predicted[chosen] = self._improve(steps[chosen], self._models[number])
        return Change(k, predicted)

    def _improve(self, steps: Ints, models: LqgModels) -> tuple[Floats, Floats]:
        rows, of_row = self._surrogate.rows, self._surrogate.series.of_row
        deviation = rows.action[steps] - rows.action_mean[steps] if self._fitted is None else self._fitted[steps]
        residual, root = self._surrogate.residual(steps), self._surrogate.root()
        improvement = backward_pass.backward_pass(models, of_row[steps], residual, root, deviation)
        return improvement.k, improvement.predicted_cost_change


def _fitted_deviation(rows: Rows, series: ModelSeries) -> Floats:
    """Recorded action minus the mean P x + p of the fitted policy [n, nu]; NaN without a dynamics sample."""
    deviation = np.full_like(rows.action, np.nan)
    P, p = (array.astype(np.float32) for array in (series.models.P, series.models.p))
    by_model = np.argsort(series.of_row, kind="stable")
    models, first = np.unique(series.of_row[by_model], return_index=True)
    for model, chosen in zip(models.tolist(), np.split(by_model, first[1:]), strict=True):
        if model != NONE:
            deviation[chosen] = rows.action[chosen] - rows.state[chosen] @ P[model].T - p[model]
    return deviation
