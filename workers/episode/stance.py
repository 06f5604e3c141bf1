"""What must hold before a worker starts: the robot stands, and the ground's file is ground."""

from __future__ import annotations

from functools import lru_cache

from t6gps.storage.errors import PhysicsError
from t6gps.workers.episode.start import settled
from t6gps.workers.ground.ground import ground
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.settings import RobotSettings, RolloutSettings

CHECK_STEPS = 25
"""A robot that cannot stand has collapsed after 2.5 s."""

COLLAPSED_M = 0.6
"""Lowest CoM of a standing robot; it is 0.89 m in the neutral shape, and 0.46 m or less once the shape is lost."""


def check_stance(settings: RolloutSettings) -> None:
    """Let the configured robot stand on flat ground, and the heaviest and softest one that randomisation may draw.

    A file that describes the ground is read. Raises PhysicsError where a robot cannot stand (`check_robot`), and
    TerrainError where there is no such ground.
    """
    robot, randomisation = settings.robot, settings.randomisation
    check_robot(robot)
    if randomisation.mass_spread or randomisation.stiffness_spread:
        weakest = {
            "bar_mass_kg": robot.bar_mass_kg * (1 + randomisation.mass_spread),
            "cable_stiffness_n_per_m": robot.cable_stiffness_n_per_m * (1 - randomisation.stiffness_spread),
        }
        check_robot(robot.model_copy(update=weakest))
    if settings.terrain.file is not None:
        ground(settings.terrain, 0, settings.terrain.difficulty)


@lru_cache(maxsize=8)
def check_robot(robot: RobotSettings) -> None:
    """Let the robot settle on a Delta of flat ground for 2.5 s, its winches holding the neutral shape.

    Raises PhysicsError where no command holds that shape, or where the robot collapses: its CoM sinks below 0.6 m.
    """
    nominal_m = nominal_rest_length(robot)
    if not robot.shortest_command_m <= nominal_m <= robot.longest_command_m:
        raise PhysicsError(
            f"robot.pretension_n = {robot.pretension_n} and robot.cable_stiffness_n_per_m = "
            f"{robot.cable_stiffness_n_per_m} need rest lengths of {nominal_m:.3f} m at the neutral shape; allowed: "
            f"commands from {robot.shortest_command_m} to {robot.longest_command_m} m; change one of them, or "
            "robot.attachment_span_m"
        )
    with PyBulletEngine(robot) as engine:
        state = settled(engine, robot, CHECK_STEPS)
    if state.com[2] < COLLAPSED_M:
        raise PhysicsError(
            f"with these settings of the robot its stance collapses: the CoM settles at {state.com[2]:.2f} m, below "
            f"{COLLAPSED_M} m; raise robot.pretension_n, cable_stiffness_n_per_m or cable_max_tension_n, or lower "
            "robot.bar_mass_kg"
        )
