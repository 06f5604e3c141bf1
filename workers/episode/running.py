"""An episode in progress: what the recorded rollout and the Gymnasium environment have in common."""

from __future__ import annotations

from collections import deque
from math import hypot

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.episode.start import random_start, rest_start
from t6gps.workers.episode.streams import Stream, generator
from t6gps.workers.episode.task import Course, one_direction, random_waypoints
from t6gps.workers.ground.ground import ground
from t6gps.workers.physics.engine import CONTROL_STEP_S, Engine, Unique
from t6gps.workers.physics.observer import observe, survey
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter
from t6gps.workers.settings import RolloutSettings


class RunningEpisode(Unique):
    """The robot on its way; it depends on the arguments and the commands alone, whatever the engine did before.

    state, frame, yaw_rad     the present state, its support triangle, and the turn of its frame
    waypoint, target          active waypoint (m) and the horizontal unit vector to it, x and y in the world
    observation               what a policy may see now [83], with noise and bias of the sensors if they have any
    course                    progress along the waypoints
    ground                    None for the endless plane
    noise_rng                 the stream for exploration; start and course have streams of their own

    Observed rest lengths are centred on `nominal_m`, the policy's own, whatever robot it meets. Commands act
    `delay_steps` control steps after they are given; until then the winches hold. `number` chooses among the
    directions of the task if it has any. Raises PhysicsError if the robot cannot even start, TerrainError if there is
    no such ground.
    """

    def __init__(
        self,
        engine: Engine,
        settings: RolloutSettings,
        seed: int,
        terrain_seed: int,
        terrain_difficulty: float,
        nominal_m: float,
        delay_steps: int = 0,
        number: int = 0,
    ) -> None:
        robot, task = settings.robot, settings.task
        start_rng, course_rng, self.noise_rng = (
            generator(seed, stream) for stream in (Stream.START, Stream.COURSE, Stream.EXPLORATION)
        )
        self.ground = ground(settings.terrain, terrain_seed, terrain_difficulty)
        engine.set_ground(self.ground)
        self._engine, self._task = engine, task
        self._sensor_noise, bias = settings.randomisation.sensor_noise, settings.randomisation.sensor_bias
        if self._sensor_noise:
            self._sensor_rng = generator(seed, Stream.SENSORS)
        self._bias = bias * _readings(generator(seed, Stream.BIAS)) if bias else None
        self._nominal_m = nominal_m
        self._step = 0
        if task.directions is not None:
            self.state = rest_start(engine, robot)
            waypoints = one_direction(number, self.state.com[:2], task.directions)
        else:
            self.state = random_start(engine, robot, self.ground, start_rng)
            waypoints = random_waypoints(course_rng, self.state.com[:2], task)
        self.course = Course(waypoints, task)
        self._delayed = deque([self.state.rest_lengths] * delay_steps)
        self._look(None)

    def advance(self, command: NDArray[np.float64]) -> None:
        """Take one control step under commanded rest lengths [24] (m) in world labels.

        UnsoundStateError if it leaves the range of sound states; then everything but the engine stays as it was.
        """
        self._delayed.append(command)
        self.state = self._engine.control_step(self._delayed.popleft())
        self._step += 1
        self._look(self.frame)

    def head_for(self, x: float, y: float) -> None:
        """Make this the only waypoint from now on (m)."""
        self.course = Course(np.array([[x, y]]), self._task)
        self._look(self.frame)

    def move_to(self, state: RobotState, engine: Engine) -> None:
        """Continue from another state, in an engine that has the episode's ground; past contacts are forgotten."""
        engine.reset(state)
        self._engine, self.state = engine, engine.state()
        self._look(self.frame)

    def _look(self, previous: SupportFrame | None) -> None:
        face, x, y, _ = survey(self.state)
        if previous is None or face != previous.face:
            self.frame = enter(face, previous, self.state)
        self.waypoint = self.course.advance(x, y, self._step * CONTROL_STEP_S)
        way_x, way_y = self.waypoint[0] - x, self.waypoint[1] - y
        distance = hypot(way_x, way_y)
        self.target = (way_x / distance, way_y / distance)
        self.yaw_rad, self.observation = observe(self.state, self.frame, self.target, self._nominal_m)
        readings = self.observation[1:]  # the support triangle is known
        if self._sensor_noise:
            readings += self._sensor_noise * _readings(self._sensor_rng)
        if self._bias is not None:
            readings += self._bias


def _readings(rng: np.random.Generator) -> NDArray[np.float32]:
    """A standard normal number for each reading."""
    return rng.standard_normal(OBSERVATION_N - 1, dtype=np.float32)
