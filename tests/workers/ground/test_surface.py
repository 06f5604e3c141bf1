"""Laws of grounds from files, inclines and fences."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.ground import FENCE_HEIGHT_M, fenced, ground, tilted
from t6gps.workers.ground.surface import load
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.settings import RobotSettings, TerrainSettings

HILLS = generate(4, 1.0, 10.0)


def surface(path: Path, terrain: Terrain = HILLS, drop: int = 0) -> Path:
    vertices, faces = terrain.triangles()
    trimesh.Trimesh(vertices, faces[: len(faces) - drop], process=False).export(path)
    return path


def test_a_height_map_is_read_as_it_is(tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", HILLS.heights)
    read = load(tmp_path / "map.npy", 10.0, 1.55)
    assert np.array_equal(read.heights, HILLS.heights)
    assert read.cell_m == 0.5


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (16, np.uint16)])
def test_a_picture_lies_as_a_map_with_white_as_high(tmp_path: Path, bits: int, dtype: type) -> None:
    grey = np.zeros((21, 21), dtype=dtype)
    grey[0, 20] = 2**bits - 1  # top right: largest x, largest y
    Image.fromarray(grey).save(tmp_path / "map.png")
    read = load(tmp_path / "map.png", 10.0, 1.5)
    assert read.heights[20, 20] == pytest.approx(1.5)
    assert np.count_nonzero(read.heights) == 1


@pytest.mark.parametrize("name", ["hills.stl", "hills.obj"])
def test_a_surface_is_draped_over_the_same_grid(tmp_path: Path, name: str) -> None:
    read = load(surface(tmp_path / name), 10.0, 1.55)
    assert np.allclose(read.heights, HILLS.heights, atol=1e-6)


def test_of_two_sheets_the_upper_one_counts(tmp_path: Path) -> None:
    lower = surface(tmp_path / "lower.stl")
    vertices, faces = HILLS.triangles()
    both = trimesh.util.concatenate([trimesh.load(lower), trimesh.Trimesh(vertices + [0, 0, 0.3], faces)])
    both.export(tmp_path / "both.stl")
    assert np.allclose(load(tmp_path / "both.stl", 10.0, 1.55).heights, HILLS.heights + 0.3, atol=1e-5)


def broken(path: Path) -> Path:
    path.write_text("not a file of this kind")
    return path


def saved(path: Path, heights: object) -> Path:
    np.save(path, np.asarray(heights))
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: d / "map.tif", ["'.tif'", ".npy, .png, .stl, .obj"]),
        (lambda d: d / "missing.npy", ["no file"]),
        (lambda d: broken(d / "broken.npy"), ["not an array"]),
        (lambda d: broken(d / "broken.png"), ["not a picture"]),
        (lambda d: saved(d / "text.npy", [["a"]]), ["real numbers"]),
        (lambda d: saved(d / "long.npy", np.zeros((5, 9))), ["square", "[5, 9]"]),
        (lambda d: saved(d / "nan.npy", np.full((21, 21), np.nan)), ["441 heights are not finite", "[0, 0]"]),
        (lambda d: saved(d / "coarse.npy", np.zeros((4, 4))), ["3.33 m apart", "terrain.size_m"]),
        (lambda d: saved(d / "steep.npy", 20 * HILLS.heights), ["cannot be stood on"]),
        (lambda d: surface(d / "hole.stl", drop=30), ["holes", "close them"]),
        (lambda d: surface(d / "small.obj", generate(4, 1.0, 6.0)), ["6.00 x 6.00 m", "terrain.size_m"]),
    ],
)  # fmt: skip
def test_a_file_that_is_no_ground_is_refused(tmp_path: Path, make: object, words: list[str]) -> None:
    path = make(tmp_path)  # type: ignore[operator]
    with pytest.raises(TerrainError) as error:
        load(path, 10.0, 1.55)
    for word in words:
        assert word in str(error.value)


def test_flat_and_level_ground_is_the_endless_plane() -> None:
    assert ground(TerrainSettings(), seed=1, difficulty=0.0) is None


def test_an_incline_has_its_slope_everywhere() -> None:
    plane = generate(0, 0.0, 10.0)
    slope, spread, _ = tilted(plane, 26.0).statistics()
    assert slope == pytest.approx(26.0)
    assert spread == pytest.approx(0.0, abs=1e-5)
    rough = tilted(HILLS, 10.0)
    assert np.allclose(np.diff((rough.heights - HILLS.heights)[:, 3]), np.tan(np.radians(10.0)) * 0.5)


def test_a_robot_thrown_at_the_fence_stays_inside() -> None:
    robot = RobotSettings()
    terrain = fenced(generate(0, 0.0, 10.0))
    assert terrain.heights.max() == FENCE_HEIGHT_M
    with PyBulletEngine(robot) as engine:
        for direction in ([2.0, 0.0, 0.0], [-2.0, 2.0, 0.0]):
            engine.set_ground(terrain)
            start = neutral_state(robot).but(bar_velocities=np.tile(direction, (6, 1)))
            engine.reset(start)
            for _ in range(60):
                state = engine.control_step(start.rest_lengths)
            assert np.abs(state.com[:2]).max() < terrain.half_size_m
