"""Closest points of segments and triangles are that; the robot moves as with Bullet alone, others just as with it."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import generate
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.bullet_hooks import overrides
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings

Array = NDArray[np.float64]


def _distances(points: Array, corners: Array) -> Array:
    """Distances [n] of points [n, 3] from a triangle."""
    edges = corners[[1, 2]] - corners[0]
    shares = np.linalg.lstsq(edges.T, (points - corners[0]).T, rcond=None)[0].T
    inside = (shares >= 0).all(axis=1) & (shares.sum(axis=1) <= 1)
    on_plane = np.linalg.norm(corners[0] + shares @ edges - points, axis=1)
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.clip(((points[:, None] - corners) * sides).sum(2) / (sides**2).sum(1), 0.0, 1.0)
    on_sides = np.linalg.norm(corners + along[..., None] * sides - points[:, None], axis=2).min(axis=1)
    return np.where(inside, on_plane, on_sides)


class _Closest(ctypes.Structure):
    _fields_ = (
        ("distance2", ctypes.c_double),
        ("on_segment", ctypes.c_double * 3),
        ("on_triangle", ctypes.c_double * 3),
    )


def _closest(start: Array, along: Array, corners: Array, reach_m: float = np.inf) -> _Closest | None:
    """Closest points of a segment and a triangle, None if they are farther apart than `reach_m`."""
    padded, closest = np.zeros((3, 4)), _Closest()
    padded[:, :3] = corners
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (start, along, padded)]
    library = ctypes.CDLL(str(overrides.library_path()))
    near = library.closest_points(*pointers, ctypes.c_double(reach_m), ctypes.byref(closest))
    return closest if near else None


def test_closest_points_are_nearer_than_any_sampled_ones() -> None:
    rng = np.random.default_rng(0)
    shares = np.linspace(0.0, 1.0, 1001)[:, None]
    crossing = 0
    for _ in range(300):
        start, along, corners = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(3, 3))
        sampled = _distances(start + shares * along, corners).min()
        closest = _closest(start, along, corners)
        assert closest is not None
        distance = np.sqrt(closest.distance2)
        step = np.linalg.norm(along) / 2000  # no point of the segment is farther from a sampled one
        assert sampled - step - 1e-9 <= distance <= sampled + 1e-9
        if distance == 0:
            crossing += 1
            continue
        on_segment, on_triangle = np.array(closest.on_segment), np.array(closest.on_triangle)
        assert np.isclose(np.linalg.norm(on_segment - on_triangle), distance, rtol=1e-12, atol=0)
        assert _distances(on_triangle[None], corners)[0] < 1e-12
        share = (on_segment - start) @ along / (along @ along)
        assert -1e-12 <= share <= 1 + 1e-12
        assert np.allclose(start + share * along, on_segment, rtol=0, atol=1e-12)
        assert _closest(start, along, corners, distance * (1 + 1e-9)) is not None
        assert _closest(start, along, corners, distance * (1 - 1e-9)) is None
    assert crossing > 2


def test_a_segment_along_a_triangle_has_its_distance() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for y in (0.2, 0.0):  # over the middle of the triangle, and over one of its edges
        closest = _closest(np.array([-5.0, y, 0.04]), np.array([10.0, 0.0, 0.0]), corners)
        assert closest is not None
        assert np.isclose(np.sqrt(closest.distance2), 0.04, rtol=1e-12)


def _motion() -> Array:
    """Positions of the bars over 2 s on three rough grounds and on the plane [4, 20, 6, 3] (m)."""
    rng = np.random.default_rng(3)
    motions = []
    with PyBulletEngine(RobotSettings()) as engine:
        for terrain in [*(generate(seed, 1.0) for seed in range(3)), None]:
            engine.set_ground(terrain)
            engine.reset(neutral_state(engine.robot, 1.9))
            commands = rng.uniform(0.5, 1.5, (20, CABLES_N))
            motions.append([engine.control_step(command).bar_positions for command in commands])
    return np.array(motions)


def _motion_of_boxes(addition: str) -> Array:
    """Positions of boxes that fall on each other, over 1 s [240, boxes, 3] (m), with what is left to Bullet's solver.

    addition: a "rigid" body on them or "apart", "rolling" friction, a "joint" between two, or a box with a "link".
    """
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    create = partial(pybullet.createMultiBody, physicsClientId=client)
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.2, 0.2, 0.2], physicsClientId=client)
    create(0, plane, useMaximalCoordinates=True)
    bodies = [create(1, box, basePosition=[0.1 * i, 0, 0.3 + 0.5 * i]) for i in range(1 if addition == "apart" else 4)]
    if addition in ("rigid", "apart"):
        position = [0.2, 0.1, 2.5] if addition == "rigid" else [3.0, 0.0, 0.3]
        bodies.append(create(1, box, basePosition=position, useMaximalCoordinates=True))
    elif addition == "rolling":
        pybullet.changeDynamics(bodies[0], -1, rollingFriction=0.1, spinningFriction=0.1, physicsClientId=client)
    elif addition == "joint":
        ends = [[0, 0, 0], [0.5, 0, 0], [-0.5, 0, 0]]
        pybullet.createConstraint(
            bodies[0], -1, bodies[2], -1, pybullet.JOINT_POINT2POINT, *ends, physicsClientId=client
        )
    else:
        link = {"Masses": [1], "CollisionShapeIndices": [box], "VisualShapeIndices": [-1], "Positions": [[0.5, 0, 0]]}
        link |= {"Orientations": [[0, 0, 0, 1]], "InertialFramePositions": [[0, 0, 0]], "ParentIndices": [0]}
        link |= {"InertialFrameOrientations": [[0, 0, 0, 1]], "JointTypes": [0], "JointAxis": [[0, 1, 0]]}
        named = {f"link{name}": value for name, value in link.items()}
        bodies.append(create(1, box, basePosition=[0.2, 0.1, 2.5], **named))
        pybullet.setJointMotorControl2(bodies[-1], 0, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=client)
    motion = []
    for _ in range(240):
        pybullet.stepSimulation(physicsClientId=client)
        motion.append([pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0] for body in bodies])
    pybullet.disconnect(physicsClientId=client)
    return np.array(motion)


def _motions() -> dict[str, Array]:
    return {"bars": _motion()} | {
        name: _motion_of_boxes(name) for name in ("rigid", "apart", "rolling", "joint", "link")
    }


@pytest.mark.slow
def test_motion_is_that_of_bullet_alone(tmp_path: Path) -> None:
    assert overrides.take_over()
    bare = {**os.environ, "T6GPS_PHYSICS": "bullet"}
    subprocess.run([sys.executable, __file__, tmp_path / "bare.npz"], env=bare, check=True)
    with np.load(tmp_path / "bare.npz") as motions:
        for name, motion in _motions().items():
            assert np.abs(motions[name] - motion).max() < 1e-9, name


def test_overrides_say_whether_they_are_active_and_exclude_bullet_alone() -> None:
    assert overrides.take_over()
    assert overrides.active() == {"contacts": True, "solver": True}
    with pytest.raises(PhysicsError, match="has overridden its contacts and its solver; set the variable before"):
        PyBulletEngine(RobotSettings(), "bullet")


def test_a_library_without_bullet_has_none_of_its_symbols() -> None:
    path = overrides.library_path()
    assert path is not None
    names = ["closest_points", "_ZTV24btConvexTriangleCallback"]
    assert set(overrides.symbol_values(path, names)) == {"closest_points"}


if __name__ == "__main__":
    assert not any(overrides.active().values())
    np.savez(sys.argv[1], **_motions())
    assert not any(overrides.active().values())
