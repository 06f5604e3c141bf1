"""Laws of the stance: published robots stand, and no worker is made for one that cannot or for ground that is none."""

from __future__ import annotations

import pytest

from t6gps.storage.errors import PhysicsError, TerrainError
from t6gps.workers.episode.stance import check_robot, check_stance
from t6gps.workers.settings import RandomisationSettings, RobotSettings, RolloutSettings, TerrainSettings
from t6gps.workers.worker import RolloutWorker


@pytest.mark.parametrize("stiffness_n_per_m", [1000.0, 2000.0, 4000.0])
def test_the_published_robots_stand(stiffness_n_per_m: float) -> None:
    check_robot(RobotSettings(cable_stiffness_n_per_m=stiffness_n_per_m))


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (RobotSettings(bar_mass_kg=20.0), "collapses: the CoM settles at 0.4"),
        (RobotSettings(cable_stiffness_n_per_m=500.0, pretension_n=50.0), "raise robot.pretension_n"),
        (RobotSettings(cable_stiffness_n_per_m=500.0, pretension_n=400.0), "need rest lengths of 0.388 m"),
    ],
)
def test_a_robot_that_cannot_stand_is_refused(robot: RobotSettings, words: str) -> None:
    with pytest.raises(PhysicsError, match=words):
        check_robot(robot)


def test_no_worker_is_made_for_a_robot_that_cannot_stand() -> None:
    with pytest.raises(PhysicsError, match="stance collapses"):
        RolloutWorker(RolloutSettings(robot=RobotSettings(bar_mass_kg=20.0)))


def test_the_heaviest_and_softest_drawn_robot_must_stand_too() -> None:
    robot = RobotSettings(bar_mass_kg=10.0)
    check_stance(RolloutSettings(robot=robot))
    spread = RandomisationSettings(mass_spread=0.5, stiffness_spread=0.5)
    with pytest.raises(PhysicsError, match="stance collapses"):
        check_stance(RolloutSettings(robot=robot, randomisation=spread))


def test_no_worker_is_made_for_a_file_that_is_no_ground() -> None:
    with pytest.raises(TerrainError, match=r"no file none\.stl"):
        RolloutWorker(RolloutSettings(terrain=TerrainSettings(file="none.stl")))
