"""Pictures of recorded episodes: what hides what, and that a picture depends on the record alone."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from t6gps.storage import fields, schema
from t6gps.storage.errors import ConfigError
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.pictures import scene
from t6gps.workers.pictures.landscape import Landscape
from t6gps.workers.pictures.raycast import Camera, cast_ground, cast_rods, cast_shadow
from t6gps.workers.pictures.render import render, snapshots, still
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.settings import RobotSettings

SMALL = (160, 90)


def _frames(rows: int, terrain: Terrain | None = None) -> pa.Table:
    """A neutral robot that slides along x, 0.05 m a row."""
    state = neutral_state(RobotSettings())
    columns = {field.name: [0] * rows for field in schema.FRAMES}
    for field in schema.FRAMES:
        if length := fields.vector_length(field):
            columns[field.name] = [[0.0] * length] * rows
    ground = 0.0 if terrain is None else float(terrain.heights.max())
    shift = [np.array([0.05 * row, 0.0, ground]) for row in range(rows)]
    columns |= {
        "step": list(range(rows)),
        "time_s": [0.1 * row for row in range(rows)],
        "waypoint_x_m": [3.0] * rows,
        "bar_positions": [(state.bar_positions + s).ravel() for s in shift],
        "bar_orientations": [state.bar_orientations.ravel()] * rows,
    }
    return pa.table([pa.array(columns[f.name], f.type) for f in schema.FRAMES], schema=schema.FRAMES)


def _camera(eye: list[float], width: int = 81, height: int = 61) -> Camera:
    """Looks along x."""
    u = (np.arange(width) - width // 2) * 0.01
    v = -(np.arange(height) - height // 2) * 0.01
    return Camera(np.array(eye), np.array([1.0, 0.0]), u.astype(np.float32), v.astype(np.float32))


def _ridge(height_m: float) -> Terrain:
    """Flat ground with a ridge along y at x = 0."""
    heights = np.zeros((41, 41))
    heights[20] = height_m
    return Terrain(heights, 0.5)


def _cast(camera: Camera, terrain: Terrain | None) -> np.ndarray:
    landscape = Landscape(terrain, np.array([0.0, 0.6, 0.8]))
    return cast_ground(camera, landscape.height, landscape.creases)


def test_rays_meet_flat_ground_where_geometry_says() -> None:
    camera = _camera([0.0, 0.0, 2.0])
    depth = _cast(camera, None)
    down = camera.v < -0.05
    expected = np.broadcast_to((-2.0 / camera.v[down])[:, None], depth[down].shape)
    np.testing.assert_allclose(depth[down], expected, rtol=1e-4)
    assert np.isinf(depth[camera.v >= 0]).all()


def test_rays_meet_rough_ground_on_its_facets() -> None:
    terrain = generate(3, 1.0)
    camera = _camera([-3.0, 0.4, 2.0])
    depth = _cast(camera, terrain)
    rows, columns = np.nonzero(depth < 15)
    x, y, z = camera.points(rows, columns, depth[rows, columns])
    assert len(rows) > 1000
    np.testing.assert_allclose(z, terrain.height(x, y), atol=1e-3)
    ahead = depth[rows, columns][:, None] * np.linspace(0.05, 0.98, 40)
    sight = camera.points(rows[:, None], columns[:, None], ahead)
    assert (sight[2] > terrain.height(sight[0], sight[1]) - 2e-3).all()


def test_a_nearer_rod_hides_a_farther_one() -> None:
    camera = _camera([0.0, 0.0, 1.0])
    a = np.array([[6.0, -1.0, 1.0], [3.0, 0.0, 0.0]])
    b = np.array([[6.0, 1.0, 1.0], [3.0, 0.0, 2.0]])
    sky = np.full((61, 81), np.inf, np.float32)
    rows, columns, rod, depth = cast_rods(camera, a, b, np.full(2, 0.1), sky)
    picture = np.full((61, 81), -1)
    picture[rows, columns] = rod
    assert picture[30, 40] == 1
    assert picture[30, 30] == 0
    assert depth[(rows == 30) & (columns == 40)][0] == pytest.approx(2.9, abs=1e-6)


def test_a_rod_shows_its_exact_silhouette() -> None:
    camera = _camera([0.0, 0.0, 1.0], 401, 301)
    ball = np.array([[4.0, 0.3, 1.2]])
    sky = np.full((301, 401), np.inf, np.float32)
    rows, columns, _, _ = cast_rods(camera, ball, ball + [0, 0, 1e-6], np.array([0.5]), sky)
    drawn = np.zeros((301, 401), bool)
    drawn[rows, columns] = True
    ray = np.stack(np.broadcast_arrays(1.0, -camera.u[None], camera.v[:, None]), axis=-1)
    along = ray @ (ball[0] - camera.eye) / (ray**2).sum(axis=-1)
    miss = np.linalg.norm(along[..., None] * ray - (ball[0] - camera.eye), axis=-1)
    np.testing.assert_array_equal(drawn, miss < 0.5)


def test_a_hill_hides_the_rod_behind_it() -> None:
    camera = _camera([-3.0, 0.0, 0.5])
    a, b = np.array([[1.0, 0.0, 0.1]]), np.array([[1.0, 0.0, 0.4]])
    for height_m, hidden in ((0.0, False), (1.0, True)):
        rows, *_ = cast_rods(camera, a, b, np.array([0.05]), _cast(camera, _ridge(height_m)))
        assert (len(rows) == 0) == hidden


def test_the_camera_avoids_views_that_a_hill_blocks() -> None:
    heights = np.zeros((41, 41))
    heights[14:17, 14:26] = 4.0  # a wall behind the robot, where the camera would like to stand
    blocked = scene.build(_frames(1), Terrain(heights, 0.5), [0])
    free = scene.build(_frames(1), None, [0])
    assert free.forward @ blocked.forward < 0.9


def test_a_shadow_lies_opposite_to_the_sun() -> None:
    sun = np.array([0.6, 0.0, 0.8])
    a = np.array([[0.0, -1.0, 1.0]])
    plane, corner, light = cast_shadow(sun, 0.0, a, a + [0.0, 2.0, 0.0], np.array([0.1]))

    def lit(x: float) -> float:
        i, j = ((np.array([x, 0.0, 0.0]) @ plane - corner) / 0.01).astype(int)
        return float(light[i, j]) if 0 <= i < light.shape[0] and 0 <= j < light.shape[1] else 1.0

    assert lit(-0.75) < 0.05
    assert lit(0.0) == lit(0.75) == 1.0


def test_the_same_record_gives_the_same_picture() -> None:
    terrain = generate(5, 1.0)
    frames = _frames(4, terrain)
    first, second = (still(frames, terrain, 2, SMALL) for _ in range(2))
    assert first.shape == (90, 160, 3)
    np.testing.assert_array_equal(first, second)
    assert first.std() > 10


def test_a_picture_does_not_depend_on_later_rows_of_its_track() -> None:
    frames = _frames(60)
    scenes = [scene.build(table, None, [5]) for table in (frames, frames.slice(0, 6))]
    first, second = (s.rods(5) for s in scenes)
    np.testing.assert_array_equal(first.a, second.a)


def test_snapshots_stand_side_by_side() -> None:
    sheet = snapshots(_frames(5), None, [0, 4])
    assert sheet.shape == (420, 2 * 640 + 6, 3)
    assert (sheet[:, 640:646] == 255).all()
    assert (sheet[:, :640] != sheet[:, 646:]).any()


@pytest.mark.slow
def test_a_film_has_one_picture_per_row(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    render(_frames(3), None, tmp_path / "film.mp4", progress=lambda done, total: seen.append((done, total)))
    count, seconds = imageio_ffmpeg.count_frames_and_secs(tmp_path / "film.mp4")
    assert (count, seconds) == (3, pytest.approx(0.3))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.slow
def test_a_picture_file_holds_the_middle_row_by_default(tmp_path: Path) -> None:
    frames = _frames(3)
    render(frames, None, tmp_path / "a.png")
    render(frames, None, tmp_path / "b.png", step=1)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (1280, 720)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.gif", {}, r"found the suffix '\.gif'; allowed: \.png"),
        ("none/a.png", {}, "there is no folder"),
        ("a.png", {"step": 3}, "no step 3; allowed: 0 to 2"),
        ("a.png", {"step": -1}, "no step -1"),
        ("a.png", {"strip": 4}, "1 to 3 rows"),
        ("a.png", {"step": 1, "strip": 2}, "exclude each other"),
        ("a.mp4", {"step": 1}, "exclude each other"),
    ],
)
def test_a_refusal_writes_nothing(tmp_path: Path, name: str, options: dict[str, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        render(_frames(3), None, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_cables_are_drawn_from_where_they_attach() -> None:
    drawn = scene.build(_frames(1), None, [0], scene.Sizes(attachment_span_m=1.65)).rods(0)
    ends = np.stack([drawn.a, drawn.b], axis=1)[drawn.part == scene.CABLE]
    nodes = neutral_state(RobotSettings()).nodes()
    gaps = np.linalg.norm(ends[:, :, None] - nodes, axis=-1).min(axis=-1)
    np.testing.assert_allclose(gaps, (1.94 - 1.65) / 2, atol=1e-6)
