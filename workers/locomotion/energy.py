"""Work of the winches, from states ten times a second.

    r        rest length of a cable          T    its tension by the law of the simulation (physics/cables.py)
    W        work that its winch does        W = sum over steps of (T[t] + T[t+1]) / 2 * max(0, r[t] - r[t+1])

A winch does work while it hauls in against the tension. What a cable gives back while the winch pays out counts as
nothing, neither gain nor loss, and so does holding.
"""

from __future__ import annotations

import numpy as np

from t6gps.workers.physics.cables import tensions
from t6gps.workers.robot.state import RobotState
from t6gps.workers.settings import RobotSettings


def winch_work_j(states: RobotState, robot: RobotSettings) -> float:
    """Work of all 24 winches (J) along states [T + 1]."""
    tension, _ = tensions(states, robot)
    hauled = np.maximum(0.0, -np.diff(states.rest_lengths, axis=0))
    return float(((tension[:-1] + tension[1:]) / 2 * hauled).sum())
