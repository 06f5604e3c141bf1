"""The task: five random waypoints one after the other, and the cost on the CoM velocity (paper Sec. IV-A)."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.settings import TaskSettings

Array = NDArray[np.float64]

AREA_HALF_WIDTH_M = 15.0
"""Waypoints lie within this distance of the origin along x and along y, away from the edge of the ground."""

FAR_WAYPOINT_M = 1000.0
"""Far enough that its direction stays the same during an episode."""


def random_waypoints(rng: np.random.Generator, start: Array, settings: TaskSettings) -> Array:
    """A chain of waypoints [n, 2] (m) from `start` [2], in random directions, all within the area."""
    waypoints = np.empty((settings.waypoints, 2))
    place = tuple(start)
    for i in range(settings.waypoints):
        inside = False
        while not inside:
            distance = rng.uniform(settings.nearest_waypoint_m, settings.farthest_waypoint_m)
            angle = rng.uniform(-pi, pi)
            x, y = place[0] + distance * cos(angle), place[1] + distance * sin(angle)
            inside = max(abs(x), abs(y)) <= AREA_HALF_WIDTH_M
        place = waypoints[i] = x, y
    return waypoints


def one_direction(number: int, start: Array, directions: int) -> Array:
    """A single waypoint [1, 2] (m) far from `start` [2] in direction `number` modulo `directions`, counted from +x."""
    angle = 2 * np.pi * (number % directions) / directions
    waypoint: Array = start + FAR_WAYPOINT_M * np.array([[np.cos(angle), np.sin(angle)]])
    return waypoint


class Course:
    """Progress along the waypoints; after the last one the first comes again.

    active     number of the active waypoint, counted on without end
    reached    waypoints reached so far
    """

    def __init__(self, waypoints: Array, settings: TaskSettings) -> None:
        self._waypoints = [(float(x), float(y)) for x, y in waypoints]
        self._radius_m, self._timeout_s = settings.waypoint_radius_m, settings.waypoint_timeout_s
        self._since_s = 0.0
        self.active = self.reached = 0

    def advance(self, x: float, y: float, time_s: float) -> tuple[float, float]:
        """Activate the next waypoint when the active one is reached or overdue; return the active one (m).

        x, y (m) is the place of the centre of mass.
        """
        waypoint = waypoint_x, waypoint_y = self.waypoint()
        arrived = hypot(waypoint_x - x, waypoint_y - y) <= self._radius_m
        if not arrived and time_s - self._since_s < self._timeout_s - 1e-9:
            return waypoint
        self.reached += arrived
        self.active += 1
        self._since_s = time_s
        return self.waypoint()

    def waypoint(self) -> tuple[float, float]:
        """The active waypoint (m)."""
        return self._waypoints[self.active % len(self._waypoints)]


def running_cost(com_velocity: Array, target_direction: Array, settings: TaskSettings) -> Array:
    """(v - v* g)' W (v - v* g) with W = diag(1, 1, vertical weight), paper eq. 3 [...] (m2/s2).

    com_velocity [..., 3] (m/s) and the horizontal unit vector target_direction [..., 2] share any frame.
    """
    lag = com_velocity[..., :2] - settings.target_speed_m_per_s * target_direction
    return (lag**2).sum(axis=-1) + settings.vertical_weight * com_velocity[..., 2] ** 2
