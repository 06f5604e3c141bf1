"""Random initial states: place, orientation and shape (paper Sec. IV-A)."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.errors import UnsoundStateError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Engine
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import RobotState, cross
from t6gps.workers.robot.topology import CABLES_N, FACES, NODES_M
from t6gps.workers.settings import RobotSettings

START_HALF_WIDTH_M = 6.0
"""Far from the sides of the smallest ground (17 m), so that the first waypoints lie on it."""

SHAPE_SPREAD_M = 0.15
"""Initial rest lengths are uniform within this distance of the nominal one."""

CLEARANCE_M = 0.05
"""Free height below the bars: ground between the points looked up may stand out by as much."""

SETTLE_STEPS = 15
"""After 1.5 s the robot lies on the ground in a shape of its own."""

REST_STEPS = 100
"""After 10 s no bar moves faster than 2 mm/s."""

REDRAWN_STARTS_N = 9
"""Ten unsound starts in a row are not chance: the robot or the ground cannot be simulated."""


def random_start(engine: Engine, robot: RobotSettings, terrain: Terrain | None, rng: np.random.Generator) -> RobotState:
    """Put the robot at a random place in a random orientation just above the ground, and let it fall and settle.

    The winches hold random rest lengths while it settles for 1.5 s, so that it comes to rest in a random shape. A start
    that leaves the range of sound states is drawn anew, nine times at most; then UnsoundStateError.
    """
    for _ in range(REDRAWN_STARTS_N):
        with suppress(UnsoundStateError):
            return _fall(engine, robot, terrain, rng)
    return _fall(engine, robot, terrain, rng)


def _fall(engine: Engine, robot: RobotSettings, terrain: Terrain | None, rng: np.random.Generator) -> RobotState:
    place = rng.uniform(-START_HALF_WIDTH_M, START_HALF_WIDTH_M, 2)
    turned = turn(neutral_state(robot), _random_quaternion(rng))
    lengths = turned.rest_lengths + rng.uniform(-SHAPE_SPREAD_M, SHAPE_SPREAD_M, CABLES_N)
    lengths = lengths.clip(robot.shortest_command_m, robot.longest_command_m)
    offset = np.array([*place, 0.0]) - [*turned.com[:2], 0.0]
    offset[2] = robot.bar_radius_m + CLEARANCE_M - _lowest_clearance(turned.nodes() + offset, terrain)
    state = turned.but(bar_positions=turned.bar_positions + offset, rest_lengths=lengths)
    engine.reset(state)
    for _ in range(SETTLE_STEPS):
        state = engine.control_step(lengths)
    return state


def rest_start(engine: Engine, robot: RobotSettings) -> RobotState:
    """Put the robot into the one rest state on flat ground: in its neutral shape, on one Delta above the origin."""
    state = _rest_state(robot)
    engine.reset(state)
    return state


@lru_cache(maxsize=8)
def _rest_state(robot: RobotSettings) -> RobotState:
    with PyBulletEngine(robot) as engine:
        return settled(engine, robot, REST_STEPS)


def settled(engine: Engine, robot: RobotSettings, steps: int) -> RobotState:
    """The robot after `steps` control steps on a Delta of flat ground, its winches holding the neutral shape."""
    corners = NODES_M[FACES[0]]
    down = corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0))
    quaternion = np.array([*np.cross(down, [0.0, 0.0, -1.0]), 1 - down[2]])
    turned = turn(neutral_state(robot), quaternion / np.linalg.norm(quaternion))
    engine.reset(turned)
    for _ in range(steps):
        state = engine.control_step(turned.rest_lengths)
    return state


def _random_quaternion(rng: np.random.Generator) -> NDArray[np.float64]:
    quaternion = rng.standard_normal(4)
    return quaternion / np.linalg.norm(quaternion)


def turn(state: RobotState, q: NDArray[np.float64]) -> RobotState:
    """The state turned about the origin by the unit quaternion q (x y z w)."""
    centre = state.com
    v, w = q[:3], q[3]
    arms = state.bar_positions - centre
    arms = arms + 2 * cross(v, cross(v, arms) + w * arms)
    b = state.bar_orientations
    vectors = w * b[:, :3] + b[:, 3:] * v + cross(v, b[:, :3])
    scalars = w * b[:, 3] - b[:, :3] @ v
    return state.but(bar_positions=arms + centre, bar_orientations=np.column_stack([vectors, scalars]))


def _lowest_clearance(nodes: NDArray[np.float64], terrain: Terrain | None) -> float:
    """Least height of the bars above the ground, looked up along each bar (m)."""
    share = np.linspace(0, 1, 9)[:, None, None]
    points = (nodes[0::2] * (1 - share) + nodes[1::2] * share).reshape(-1, 3)
    ground = 0.0 if terrain is None else terrain.height(points[:, 0], points[:, 1])
    return float((points[:, 2] - ground).min())
