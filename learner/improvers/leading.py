"""Which improver leads an iteration: the backward pass, or the action value where there is one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.improvers.by_action_value import ByActionValue
from t6gps.learner.improvers.by_backward_pass import ByBackwardPass
from t6gps.learner.improvers.improver import Improver, Surrogate
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot


def leading(
    value: ActionValue | None,
    surrogate: Surrogate,
    snapshot: PolicySnapshot,
    draws: Callable[[], np.random.Generator],
    command_range_m: tuple[float, float],
    settings: LearnerSettings,
) -> Improver:
    """The improver of a policy's actions; `draws` gives the generator for what the value learns."""
    if value is None:
        return ByBackwardPass(surrogate, settings)
    return ByActionValue(surrogate, value, snapshot, draws(), command_range_m, settings)
