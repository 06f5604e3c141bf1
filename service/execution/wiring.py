"""How a learner is made from a run's configuration."""

from __future__ import annotations

from typing import Any

from t6gps.learner.learner import Learner
from t6gps.learner.port import Task
from t6gps.service.config import Config
from t6gps.workers.physics.engine import reach_m
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.symmetry import CABLE_MAP, PROPER

ACTION_SCALE_M = 0.2
"""Rest length per unit of the policy's output (m)."""


def new_learner(config: Config, **options: Any) -> Learner:
    """The learner of a run, with its first policy."""
    robot = config.robot
    task = Task(
        target_speed_m_per_s=config.task.target_speed_m_per_s,
        vertical_weight=config.task.vertical_weight,
        command_range_m=(robot.shortest_command_m, robot.longest_command_m),
        offset_m=nominal_rest_length(robot),
        scale_m=ACTION_SCALE_M,
        reach_m=reach_m(robot),
        world_labels=CABLE_MAP,
        mirrored=~PROPER,
    )
    return Learner(config.learner, task, config.run.seed, keeps_earlier=config.run.pipelined, **options)
