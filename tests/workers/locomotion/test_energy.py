"""Laws of the work of the winches: tension times what is hauled in, and nothing for holding or paying out."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.workers.locomotion.energy import winch_work_j
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings

ROBOT = RobotSettings()


def winding(step_m: float, cables: slice = slice(None)) -> RobotState:
    """The neutral shape in 11 rows, some of its winches hauling in `step_m` from row to row."""
    still = neutral_state(ROBOT)
    hauled = np.zeros((11, CABLES_N))
    hauled[:, cables] = step_m * np.arange(11)[:, None]
    return RobotState(np.repeat(still.bars[None], 11, axis=0), still.rest_lengths - hauled)


def test_hauling_at_a_known_tension_and_rate_is_known_work() -> None:
    robot = ROBOT.model_copy(update={"cable_max_tension_n": ROBOT.pretension_n})  # 200 N, however far it hauls
    assert winch_work_j(winding(0.01), robot) == pytest.approx(CABLES_N * 200.0 * 0.1)
    assert winch_work_j(winding(0.01, slice(3)), robot) == pytest.approx(3 * 200.0 * 0.1)


def test_hauling_at_a_spring_is_the_energy_that_it_stores() -> None:
    first, last = ROBOT.pretension_n, ROBOT.pretension_n + ROBOT.cable_stiffness_n_per_m * 0.1
    stored = (last**2 - first**2) / (2 * ROBOT.cable_stiffness_n_per_m)
    assert winch_work_j(winding(0.01, slice(1)), ROBOT) == pytest.approx(stored)


def test_holding_and_paying_out_are_no_work_and_no_gain() -> None:
    assert winch_work_j(winding(0.0), ROBOT) == 0.0
    assert winch_work_j(winding(-0.01), ROBOT) == 0.0
