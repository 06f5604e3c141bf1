"""A law of the episode in progress that neither its record nor the environment shows alone."""

from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.settings import RobotSettings, RolloutSettings, TaskSettings


def test_for_a_robot_at_rest_the_waypoint_changes_once_per_timeout() -> None:
    robot, task = RobotSettings(), TaskSettings(waypoint_timeout_s=1.0)
    active = []
    with PyBulletEngine(robot) as engine:
        episode = RunningEpisode(
            engine,
            RolloutSettings(robot=robot, task=task),
            seed=0,
            terrain_seed=0,
            terrain_difficulty=0.0,
            nominal_m=1.0,
        )
        hold = episode.state.rest_lengths
        for _ in range(25):
            episode.advance(hold)
            active.append(episode.course.active)
    assert episode.course.reached == 0
    assert active == [0] * 9 + [1] * 10 + [2] * 6
