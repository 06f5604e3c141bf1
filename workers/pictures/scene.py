"""What stands where in the pictures of an episode: robot, waypoint, track, sun and camera, from the recorded rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures.landscape import Landscape
from t6gps.workers.pictures.raycast import Camera
from t6gps.workers.robot.recorded import numbers
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.topology import BARS, BARS_N, CABLES, CABLES_N
from t6gps.workers.settings import HALF_DIAMETER_M, RobotSettings

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

DISTANCE_M = 9.4
"""Of the camera from the robot."""

ELEVATION_RAD = np.radians(29)
"""Of the camera above the horizon."""

FIELD_OF_VIEW = 0.84
"""Width of the picture at depth 1 m (m)."""

AIM = 0.01
"""How far above the robot the camera aims, in m per m of depth."""

SMOOTHING_S = 1.5
"""The camera follows the robot's path under a Gaussian of this standard deviation, so that it does not rock."""

WAYPOINT_TURN_RAD = np.radians(35)
"""The camera likes to see the way to the waypoint go to the right and away."""

SUN_ELEVATION_RAD = np.radians(40)
"""Above most slopes of rough ground, which are 38 deg on average."""

SUN_TURN_RAD = np.radians(112)
"""The sun stands on the left, a little behind the camera."""

FLAG_HEIGHT_M = 1.0
"""Of the pole that marks the waypoint."""

BAR, CAP, CABLE, POLE, TRACK = range(5)
"""Parts, in the order of render.ROD_COLOURS."""

CAP_LENGTH_M = 0.07
"""Of the coloured ends of a bar."""

CABLE_RADIUS_M = 0.009
"""Of a drawn cable."""

POLE_RADIUS_M = 0.018
"""Of the waypoint's pole."""

BALL_RADIUS_M = 0.10
"""Of the ball on that pole."""

TRACK_RADIUS_M = 0.02
"""Of the track of the centre of mass."""


@dataclass(frozen=True)
class Sizes:
    """What an episode's frames do not hold (m): radii of a bar and of a waypoint's circle, and where cables attach."""

    bar_radius_m: float = RobotSettings().bar_radius_m
    waypoint_radius_m: float = HALF_DIAMETER_M
    attachment_span_m: float = RobotSettings().attachment_span_m


USUAL = Sizes()


@dataclass(frozen=True)
class Rods:
    """Ends a, b [n, 3] and radius r [n] (m) of everything that is drawn as a rod, and which part it is [n]."""

    a: Array
    b: Array
    r: Array
    part: Ints

    def __getitem__(self, chosen: Ints | NDArray[np.bool_]) -> Rods:
        return Rods(self.a[chosen], self.b[chosen], self.r[chosen], self.part[chosen])


@dataclass(frozen=True, kw_only=True)
class Scene:
    """An episode on its ground, seen in the fixed horizontal direction `forward` [2] from `eyes` [T + 1, 3] (m).

    com [T + 1, 3], nodes and points where cables attach [T + 1, 12, 3], waypoint [T + 1, 2] (m); `sun` is the unit
    vector to the sun.
    """

    landscape: Landscape
    forward: Array
    sun: Array
    eyes: Array
    com: Array
    nodes: Array
    attached: Array
    face: Ints
    kind: Ints
    waypoint: Array
    time_s: Array
    forward_speed_m_per_s: Array
    sizes: Sizes

    def camera(self, step: int, size: tuple[int, int]) -> Camera:
        """The camera of a row, for pictures of `size` (width, height) in rays."""
        pixel = FIELD_OF_VIEW / size[0]
        u = (np.arange(size[0]) - (size[0] - 1) / 2) * pixel
        v = AIM - np.tan(ELEVATION_RAD) - (np.arange(size[1]) - (size[1] - 1) / 2) * pixel
        return Camera(self.eyes[step], self.forward, u.astype(np.float32), v.astype(np.float32))

    def rods(self, step: int) -> Rods:
        """Bars with their caps, cables, the waypoint's flag, and the track of the centre of mass."""
        nodes, track = self.nodes[step], laid(self.com[: step + 1, :2], self.landscape.height)
        first, second = nodes[BARS].swapaxes(0, 1)
        start, end = self.attached[step][CABLES].swapaxes(0, 1)
        ends = np.concatenate([first, second])
        inward = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True) * CAP_LENGTH_M
        caps = ends + np.concatenate([inward, -inward])
        foot = np.array([[*self.waypoint[step], self.landscape.height(*self.waypoint[step])]])
        top = foot + [0.0, 0.0, FLAG_HEIGHT_M]
        point = np.array([0.0, 0.0, 1e-4])  # a rod needs some length, even where the robot has not moved
        pieces = (
            (first, second, 0.8 * self.sizes.bar_radius_m, BAR),
            (ends, caps, 1.1 * self.sizes.bar_radius_m, CAP),
            (start, end, CABLE_RADIUS_M, CABLE),
            (foot, top, POLE_RADIUS_M, POLE),
            (top, top + point, BALL_RADIUS_M, TRACK),
            (track[:-1], track[1:] + point, TRACK_RADIUS_M, TRACK),
        )
        return Rods(
            np.concatenate([a for a, _, _, _ in pieces]),
            np.concatenate([b for _, b, _, _ in pieces]),
            np.concatenate([np.full(len(a), r) for a, _, r, _ in pieces]),
            np.concatenate([np.full(len(a), part) for a, _, _, part in pieces]),
        )


def laid(path: Array, height: Callable[[Array, Array], Array]) -> Array:
    """A horizontal path [n, 2] laid on the ground of such heights, close enough to follow its facets [k, 3] (m)."""
    length = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    places = np.linspace(0, length[-1], int(length[-1] / 0.08) + 2)
    x, y = (np.interp(places, length, path[:, i]) for i in range(2))
    return np.column_stack([x, y, height(x, y) + 0.01])


def build(frames: pa.Table, terrain: Terrain | None, steps: Sequence[int], sizes: Sizes = USUAL) -> Scene:
    """The scene of an episode's `frames` on its ground (None: flat), seen from where the rows `steps` are seen best."""
    positions, orientations = (
        numbers(frames, name).reshape(-1, BARS_N, n) for name, n in (("bar_positions", 3), ("bar_orientations", 4))
    )
    rest = np.zeros_like(positions)
    state = RobotState.of(positions, orientations, rest, rest, np.zeros((len(rest), CABLES_N)))
    com, nodes, time_s = state.com, state.nodes(), numbers(frames, "time_s")
    waypoint = np.column_stack([numbers(frames, "waypoint_x_m"), numbers(frames, "waypoint_y_m")])
    weights = np.exp(-0.5 * ((time_s[:, None] - time_s) / SMOOTHING_S) ** 2)
    path = weights @ com / weights.sum(axis=1, keepdims=True)
    rows = np.unique(np.asarray(steps)[:: max(1, len(steps) // 30)])
    angle = view_angle(path[rows], nodes[rows], waypoint[rows] - com[rows, :2], terrain)
    sun = np.array([*np.cos(SUN_ELEVATION_RAD) * _unit(angle + SUN_TURN_RAD), np.sin(SUN_ELEVATION_RAD)])
    landscape = Landscape(terrain, sun)
    eyes = eyes_at(path, angle)
    eyes[:, 2] = np.maximum(eyes[:, 2], landscape.height(eyes[:, 0], eyes[:, 1]) + 1.0)
    return Scene(
        landscape=landscape,
        forward=_unit(angle),
        sun=sun,
        eyes=eyes,
        com=com,
        nodes=nodes,
        attached=state.nodes(sizes.attachment_span_m),
        face=np.asarray(schema.array(frames, "face"), dtype=np.int64),
        kind=np.asarray(schema.array(frames, "kind"), dtype=np.int64),
        waypoint=waypoint,
        time_s=time_s,
        forward_speed_m_per_s=numbers(frames, "forward_speed_m_per_s"),
        sizes=sizes,
    )


def _unit(angle_rad: float) -> Array:
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


def eyes_at(path: Array, angle_rad: float) -> Array:
    """Where the camera stands to look in a direction at places [..., 3] (m)."""
    return path + DISTANCE_M * np.array([*-np.cos(ELEVATION_RAD) * _unit(angle_rad), np.sin(ELEVATION_RAD)])


def view_angle(path: Array, nodes: Array, way: Array, terrain: Terrain | None) -> float:
    """Direction of view (rad) in which hills hide the least of the robot, by preference along the way."""
    mean_way = (way / np.linalg.norm(way, axis=1, keepdims=True).clip(1e-9)).sum(axis=0)
    preferred = float(np.arctan2(mean_way[1], mean_way[0]) + WAYPOINT_TURN_RAD)
    if terrain is None:
        return preferred
    angles = preferred + np.linspace(-np.pi, np.pi, 36, endpoint=False)
    share = np.linspace(0.02, 0.5, 24)[:, None]
    penalties = []
    for angle in angles:
        eyes = eyes_at(path, angle)[:, None, None]
        sight = nodes[:, :, None] + share * (eyes - nodes[:, :, None])
        hidden = (terrain.height(sight[..., 0], sight[..., 1]) > sight[..., 2]).any(axis=-1)
        penalties.append(hidden.mean() + 0.1 * (1 - np.cos(angle - preferred)))
    return float(angles[int(np.argmin(penalties))])
