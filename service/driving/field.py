"""The robots of a drive on their ground: what they do in a control step, and what is seen of them.

Robots do not touch each other: each has a simulator of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from t6gps.service.driving.commands import Command
from t6gps.service.driving.order import Entrant, Order
from t6gps.service.views.ground import Ground, rounded, whole
from t6gps.workers.driving import DrivenRobot, Sight
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.pictures.viewer.world import World
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, CABLES, FACES


@dataclass(frozen=True)
class Body:
    """What stays of a robot: the policy that moves it, and how it is drawn, as `views.replay.Replay` has it."""

    run: str
    version: int
    brightest_n: float
    bar_radius_m: float
    attached_share: float


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What stays until robots begin again on another ground; `friction` is that of the first robot.

    bars, cables, faces   numbers of nodes [6, 2], [24, 2], [20, 3]
    ground                None is the plane z = 0
    """

    robots: list[Body]
    bars: list[list[int]]
    cables: list[list[int]]
    faces: list[list[int]]
    step_s: float
    waypoint_radius_m: float
    friction: float
    terrain_difficulty: float
    ground: Ground | None


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a robot is: `workers.driving.Sight`, rounded, with flat lists."""

    nodes_m: list[float]
    com_m: list[float]
    tensions_n: list[float]
    face: int
    kind: int
    waypoint_m: list[float]
    distance_m: float
    reached_after_s: float | None
    speed_m_per_s: float
    ended_by: str | None


@dataclass(frozen=True)
class Frame:
    """All robots at a moment; `start` counts how often they began again."""

    start: int
    time_s: float
    paused: bool
    robots: list[Place]


@final
class Field:
    """The robots of an order. Errors as `DrivenRobot`."""

    def __init__(self, order: Order) -> None:
        self._order, self._starts_n, self._step, self.paused = order, 0, 0, False
        self._robots = [DrivenRobot(one.settings, one.policy, order.start) for one in order.entrants]
        if order.friction is not None:
            self.obey(Command(friction=order.friction))

    def obey(self, command: Command) -> bool:
        """Let everything be as a command has it; True where the scene is another then. Errors as `DrivenRobot`."""
        if command.terrain_difficulty is not None:
            self._order = self._order.at(command.terrain_difficulty)
        for robot in self._robots:
            if command.friction is not None:
                robot.set_friction(command.friction)
            if command.terrain_difficulty is not None or command.restart:
                robot.begin(self._order.start)
            if command.waypoint_m is not None:
                robot.head_for(*command.waypoint_m)
        if command.push is not None:
            self._robots[command.push.robot].push(np.array(command.push.impulse_n_s))
        if command.paused is not None:
            self.paused = command.paused
        if command.terrain_difficulty is not None or command.restart:
            self._starts_n, self._step = self._starts_n + 1, 0
        return command.terrain_difficulty is not None or command.friction is not None

    def step(self) -> None:
        """Let a control step pass, unless time stands."""
        if not self.paused:
            self._step += 1
            for robot in self._robots:
                robot.step()

    def scene(self) -> Scene:
        """What stays."""
        first, ground = self._robots[0].robot, self._robots[0].ground
        return Scene(
            robots=[_body(one, robot) for one, robot in zip(self._order.entrants, self._robots, strict=True)],
            bars=BARS.tolist(),
            cables=CABLES.tolist(),
            faces=FACES.tolist(),
            step_s=CONTROL_STEP_S,
            waypoint_radius_m=self._order.entrants[0].settings.task.waypoint_radius_m,
            friction=first.friction,
            terrain_difficulty=self._order.start.terrain_difficulty,
            ground=None if ground is None else whole(ground),
        )

    def frame(self) -> Frame:
        """What is seen now."""
        time_s = round(self._step * CONTROL_STEP_S, 4)
        return Frame(self._starts_n, time_s, self.paused, [_place(robot.sight()) for robot in self._robots])

    def close(self) -> None:
        """Release the simulators."""
        for robot in self._robots:
            robot.close()


def _body(entrant: Entrant, robot: DrivenRobot) -> Body:
    settings = robot.robot
    brightest_n = World(settings, robot.ground, entrant.settings.task.waypoint_radius_m).brightest_n
    share = settings.attachment_span_m / BAR_LENGTH_M
    return Body(entrant.run, entrant.version, brightest_n, settings.bar_radius_m, share)


def _place(sight: Sight) -> Place:
    return Place(
        nodes_m=rounded(sight.nodes_m, 4),
        com_m=rounded(sight.com_m, 4),
        tensions_n=rounded(sight.tensions_n, 1),
        face=sight.face,
        kind=sight.kind,
        waypoint_m=rounded(np.array(sight.waypoint_m), 4),
        distance_m=round(sight.distance_m, 3),
        reached_after_s=sight.reached_after_s,
        speed_m_per_s=round(sight.speed_m_per_s, 3),
        ended_by=sight.ended_by,
    )
