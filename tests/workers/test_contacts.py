"""Closest points of segments and triangles are that, and the robot moves as with Bullet's own algorithm."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t6gps.workers import contacts, physics
from t6gps.workers.physics import Simulation, neutral_state
from t6gps.workers.settings import RobotSettings
from t6gps.workers.terrain import generate
from t6gps.workers.topology import CABLES_N

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
    padded, found = np.zeros((3, 4)), _Closest()
    padded[:, :3] = corners
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (start, along, padded)]
    library = ctypes.CDLL(str(contacts.library_path()))
    near = library.closest_points(*pointers, ctypes.c_double(reach_m), ctypes.byref(found))
    return found if near else None


def test_closest_points_are_nearer_than_any_sampled_ones() -> None:
    rng = np.random.default_rng(0)
    shares = np.linspace(0.0, 1.0, 1001)[:, None]
    crossing = 0
    for _ in range(300):
        start, along, corners = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(3, 3))
        sampled = _distances(start + shares * along, corners).min()
        found = _closest(start, along, corners)
        assert found is not None
        distance = np.sqrt(found.distance2)
        step = np.linalg.norm(along) / 2000  # no point of the segment is farther from a sampled one
        assert sampled - step - 1e-9 <= distance <= sampled + 1e-9
        if distance == 0:
            crossing += 1
            continue
        on_segment, on_triangle = np.array(found.on_segment), np.array(found.on_triangle)
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
        found = _closest(np.array([-5.0, y, 0.04]), np.array([10.0, 0.0, 0.0]), corners)
        assert found is not None
        assert np.isclose(np.sqrt(found.distance2), 0.04, rtol=1e-12)


def _motion() -> Array:
    """Positions of the bars over 2 s on three rough grounds [3, 20, 6, 3] (m)."""
    rng = np.random.default_rng(3)
    motions = []
    with Simulation(RobotSettings()) as simulation:
        for seed in range(3):
            simulation.set_ground(generate(seed, 1.0))
            simulation.reset(neutral_state(simulation.robot, 1.9))
            commands = rng.uniform(0.5, 1.5, (20, CABLES_N))
            motions.append([simulation.control_step(command).bar_positions for command in commands])
    return np.array(motions)


def test_motion_is_that_of_bullet_s_own_distances(tmp_path: Path) -> None:
    assert contacts.take_over()
    subprocess.run([sys.executable, __file__, tmp_path / "own.npy"], check=True)
    assert np.abs(np.load(tmp_path / "own.npy") - _motion()).max() < 1e-9


def test_a_library_without_bullet_has_none_of_its_symbols() -> None:
    path = contacts.library_path()
    assert path is not None
    assert set(contacts._symbols(path, ["closest_points", "_ZTV24btConvexTriangleCallback"])) == {"closest_points"}


if __name__ == "__main__":
    physics.take_over = lambda: False
    np.save(sys.argv[1], _motion())
