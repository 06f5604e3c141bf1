"""Actions improved by a learned action value (beyond the paper), alone or with the backward pass that ends in it.

Alone, the local models only say what they expect of the actions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from t6gps.learner.algorithm.backward_pass import predicted_change
from t6gps.learner.improvers import by_value_and_models
from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.improvers.improver import Change, Improver, Surrogate
from t6gps.learner.rows import Floats, Ints
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot


class ByActionValue(Improver):
    """u* climbs the action value from the policy's own command."""

    def __init__(
        self,
        surrogate: Surrogate,
        value: ActionValue,
        snapshot: PolicySnapshot,
        rng: np.random.Generator,
        command_range_m: tuple[float, float],
        settings: LearnerSettings,
    ) -> None:
        self._surrogate, self._value, self._snapshot, self._rng = surrogate, value, snapshot, rng
        self._command_range_m, self._settings = command_range_m, settings
        self._F = surrogate.series.models.F.astype(np.float32)
        self._climbed: Floats = np.empty((0, 0), dtype=np.float32)

    @property
    def steps_n(self) -> int:
        """Gradient steps of the action value."""
        return self._value.steps_n

    def prepare(self) -> Iterator[None]:
        """Learn the action value of the newest policy, and climb it."""
        yield from self._value.learn(self._snapshot, self._rng)
        settings, farther = self._settings, None
        if settings.models_share:
            ends, discount = self._value.state_slopes(self._snapshot), settings.action_value.discount
            farther = by_value_and_models.slopes(self._surrogate, ends, discount, settings.models_horizon_steps)
        self._climbed = self._value.improved(self._snapshot, farther, settings.models_share)
        np.clip(self._climbed, *self._command_range_m, out=self._climbed)

    def improve(self, steps: Ints) -> Change:
        """The climbed actions, and what the local models expect of them."""
        rows, climbed = self._surrogate.rows, self._climbed[steps]
        k = climbed - rows.action[steps]
        change = rows.regressor(steps, climbed) - rows.regressor(steps, rows.action[steps])
        residual, root = self._surrogate.residual(steps), self._surrogate.root()
        return Change(k, predicted_change(self._F, self._surrogate.series.of_row[steps], residual, root, change))
