"""The test that spares Bullet triangles drops those out of reach, none within, and changes no bit."""

from __future__ import annotations

import ctypes
import hashlib
import subprocess
import sys

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


def _is_near(start: Array, along: Array, corners: Array, reach_m: float) -> bool:
    padded = np.zeros((3, 4))
    padded[:, :3] = corners
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (start, along, padded)]
    return bool(ctypes.CDLL(str(contacts.library_path())).segment_is_near(*pointers, ctypes.c_double(reach_m)))


def test_a_triangle_is_near_exactly_when_its_distance_is_within_reach() -> None:
    rng = np.random.default_rng(0)
    shares = np.linspace(0.0, 1.0, 1001)[:, None]
    crossing = 0
    for _ in range(300):
        start, along, corners = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(3, 3))
        above = _distances(start + shares * along, corners).min()
        below = above - np.linalg.norm(along) / 2000  # no point of the segment is farther from a sampled one
        assert _is_near(start, along, corners, above + 1e-9)
        if below > 0:
            assert not _is_near(start, along, corners, below - 1e-9)
        else:
            crossing += 1
    assert crossing > 2


def test_a_segment_along_a_triangle_is_near() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for height_m, near in ((0.04, True), (0.06, False)):
        start = np.array([-5.0, 0.2, height_m])
        assert _is_near(start, np.array([10.0, 0.0, 0.0]), corners, 0.05) is near
        assert _is_near(start + [0.0, -0.2, 0.0], np.array([10.0, 0.0, 0.0]), corners, 0.05) is near


def _digest() -> str:
    rng = np.random.default_rng(3)
    states = []
    with Simulation(RobotSettings()) as simulation:
        simulation.set_ground(generate(2, 1.0))
        simulation.reset(neutral_state(simulation.robot, 1.9))
        for _ in range(60):
            states.append(simulation.control_step(rng.uniform(0.5, 1.5, CABLES_N)).bar_positions)
    return hashlib.sha256(np.array(states).tobytes()).hexdigest()


def test_sparing_triangles_changes_no_bit() -> None:
    assert contacts.cull_triangles()
    plain = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    assert plain.stdout.split()[-1] == _digest()


def test_a_library_without_bullet_has_none_of_its_symbols() -> None:
    path = contacts.library_path()
    assert path is not None
    assert set(contacts._symbols(path, ["segment_is_near", "_ZTV24btConvexTriangleCallback"])) == {"segment_is_near"}


if __name__ == "__main__":
    physics.cull_triangles = lambda: False
    print(_digest())
