"""A policy that somebody drives: an episode without end, whose waypoint, friction and ground change on the way.

Without a command it is the noise-free episode of a plan, state for state (`episode.rollout`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.errors import UnsoundStateError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N, SENSORS_N
from t6gps.workers.episode import policy, streams
from t6gps.workers.episode.randomisation import draw
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.episode.streams import Stream
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.cables import tensions
from t6gps.workers.physics.engine import CONTROL_STEP_S, Unique
from t6gps.workers.physics.observer import steer
from t6gps.workers.robot.topology import BARS_N, CABLES_N
from t6gps.workers.settings import RobotSettings, RolloutSettings

Array = NDArray[np.float64]

SPEED_STEPS = 30
"""A robot's speed is the way that it has made in the last three seconds: longer than it rocks to and fro."""

_NO_NOISE = np.zeros(CABLES_N)


@dataclass(frozen=True)
class Start:
    """Where an episode begins: its seeds, how steep its ground is, and its number, as its plan has them."""

    seed: int
    terrain_seed: int
    terrain_difficulty: float
    number: int


@dataclass(frozen=True, kw_only=True)
class Sight:
    """A driven robot at a moment.

    nodes_m, com_m     ends of the bars [12, 3] and centre of mass [3] (m)
    tensions_n         of the cables [24] (N)
    face, kind         the triangle under the centre of mass, and 0 Delta or 1 Lambda
    waypoint_m         where it heads for, x and y (m)
    distance_m         of the centre of mass from there
    reached_after_s    time from when the waypoint was given until it was reached; None before, and without one given
    speed_m_per_s      way over ground in the last three seconds, or since the start, over that time
    ended_by           why it moves no more, None while it does
    """

    nodes_m: Array
    com_m: Array
    tensions_n: Array
    face: int
    kind: int
    waypoint_m: tuple[float, float]
    distance_m: float
    reached_after_s: float | None
    speed_m_per_s: float
    ended_by: str | None


class DrivenRobot(Unique):
    """One robot under one policy, in a simulator of its own.

    A robot that leaves the range of sound states stands still until it begins again. DataError for a policy that does
    not fit the robot, PhysicsError for a robot that cannot start, TerrainError where there is no such ground.
    """

    def __init__(self, settings: RolloutSettings, snapshot: PolicySnapshot, start: Start) -> None:
        policy.check(snapshot, (SENSORS_N, OBSERVATION_N), CABLES_N)
        rng = streams.generator(start.seed, Stream.ROBOT)
        robot, self._delay_steps = draw(settings.robot, settings.randomisation, rng)
        self._settings = settings.model_copy(update={"robot": robot})
        self._act, self._nominal_m = policy.ready(snapshot), snapshot.offset_m
        self._waypoint: tuple[float, float] | None = None
        self._reached_after_s: float | None = None
        self._engine = PyBulletEngine(robot)
        self.begin(start)

    @property
    def robot(self) -> RobotSettings:
        """What moves, as it was drawn for this episode."""
        return self._settings.robot

    @property
    def momentum(self) -> Array:
        """Of all bars together [3] (N s)."""
        return self.robot.bar_mass_kg * self._episode.state.bar_velocities.sum(axis=0)

    @property
    def ground(self) -> Terrain | None:
        """Where it moves; None is the endless plane."""
        return self._episode.ground

    def begin(self, start: Start) -> None:
        """Put the robot on its start; a waypoint and a friction that were given stay."""
        settings = self._settings
        if start.terrain_difficulty > 0:  # directions are for flat ground
            settings = settings.model_copy(update={"task": settings.task.model_copy(update={"directions": None})})
        self._episode = RunningEpisode(
            self._engine,
            settings,
            start.seed,
            start.terrain_seed,
            start.terrain_difficulty,
            self._nominal_m,
            self._delay_steps,
            start.number,
        )
        self._ended_by: str | None = None
        self._steps_to_waypoint, self._reached_after_s = 0, None
        self._places = deque([self._episode.state.com[:2]], maxlen=SPEED_STEPS + 1)
        if self._waypoint is not None:
            self.head_for(*self._waypoint)

    def step(self) -> None:
        """Move for a control step of 0.1 s."""
        if self._ended_by is not None:
            return
        episode, robot = self._episode, self.robot
        wanted, element = self._act(episode.observation), episode.frame.element
        _, command, _ = steer(wanted, _NO_NOISE, element, robot.shortest_command_m, robot.longest_command_m)
        try:
            episode.advance(command)
        except UnsoundStateError as error:
            self._ended_by = error.reason
            return
        self._places.append(episode.state.com[:2])
        self._steps_to_waypoint += 1
        if self._waypoint is not None and self._reached_after_s is None and self._distance_m() <= self._radius_m:
            self._reached_after_s = self._steps_to_waypoint * CONTROL_STEP_S

    def head_for(self, x: float, y: float) -> None:
        """Give it a waypoint (m), for which it heads from now on."""
        self._waypoint = (x, y)
        self._steps_to_waypoint, self._reached_after_s = 0, None
        self._episode.head_for(x, y)

    def push(self, impulse_n_s: Array) -> None:
        """Add an impulse [3] (N s), the same to each bar."""
        if self._ended_by is None:
            state = self._episode.state
            change = impulse_n_s / (BARS_N * self.robot.bar_mass_kg)
            self._episode.move_to(state.but(bar_velocities=state.bar_velocities + change), self._engine)

    def set_friction(self, friction: float) -> None:
        """Let bars and ground have another coefficient of friction, from now on."""
        robot = self.robot.model_copy(update={"friction": friction})
        engine = PyBulletEngine(robot)
        engine.set_ground(self.ground)
        self._episode.move_to(self._episode.state, engine)
        self._engine.close()
        self._engine, self._settings = engine, self._settings.model_copy(update={"robot": robot})

    def sight(self) -> Sight:
        """The robot now."""
        state, frame = self._episode.state, self._episode.frame
        first, last = self._places[0], self._places[-1]
        took_s = (len(self._places) - 1) * CONTROL_STEP_S
        return Sight(
            nodes_m=state.nodes(),
            com_m=state.com,
            tensions_n=tensions(state, self.robot)[0],
            face=frame.face,
            kind=frame.kind,
            waypoint_m=self._episode.waypoint,
            distance_m=self._distance_m(),
            reached_after_s=self._reached_after_s,
            speed_m_per_s=0.0 if not took_s else float(hypot(*(last - first)) / took_s),
            ended_by=self._ended_by,
        )

    def close(self) -> None:
        """Release the simulator."""
        self._engine.close()

    @property
    def _radius_m(self) -> float:
        return self._settings.task.waypoint_radius_m

    def _distance_m(self) -> float:
        x, y = self._episode.state.com[:2] - self._episode.waypoint
        return hypot(x, y)
