"""Laws of the rough ground."""

import numpy as np
import pytest

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet import pybullet


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_hardest_ground_has_the_papers_statistics(seed: int) -> None:
    mean_slope_deg, slope_std_deg, range_m = generate(seed, 1.0).statistics()
    assert mean_slope_deg == pytest.approx(38.2, abs=1.0)
    assert slope_std_deg == pytest.approx(16.0, abs=1.0)
    assert range_m == pytest.approx(1.55, rel=0.02)


def test_difficulty_scales_the_heights_of_the_same_hills() -> None:
    for difficulty in (0.3, 1.5):
        np.testing.assert_allclose(generate(5, difficulty).heights, difficulty * generate(5, 1.0).heights, rtol=1e-12)
    assert not generate(5, 0.0).heights.any()


def test_a_seed_decides_the_ground() -> None:
    np.testing.assert_array_equal(generate(9, 1.0).heights, generate(9, 1.0).heights)
    assert not np.allclose(generate(9, 1.0).heights, generate(10, 1.0).heights)


@pytest.mark.parametrize("size_m", [4.0, 40.0])
def test_the_ground_has_the_size_asked_for_and_its_centre_at_the_origin(size_m: float) -> None:
    vertices, _ = generate(0, 1.0, size_m).triangles()
    np.testing.assert_allclose(vertices[:, :2].min(axis=0), -size_m / 2)
    np.testing.assert_allclose(vertices[:, :2].max(axis=0), size_m / 2)


def test_height_interpolates_on_the_triangle_that_holds_the_point() -> None:
    terrain = generate(3, 1.0, 10.0)
    vertices, faces = terrain.triangles()
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(3), len(faces))
    points = np.einsum("fc,fcd->fd", shares, vertices[faces])
    np.testing.assert_allclose(terrain.height(points[:, 0], points[:, 1]), points[:, 2], atol=1e-12)


def test_triangles_cover_the_square_once_and_look_up() -> None:
    terrain = generate(3, 1.0, 10.0)
    vertices, faces = terrain.triangles()
    corners = vertices[faces]
    doubled_areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    np.testing.assert_allclose(doubled_areas, terrain.cell_m**2)
    assert len(faces) * terrain.cell_m**2 / 2 == pytest.approx(100.0)


def test_height_equals_what_a_ray_meets() -> None:
    terrain = generate(4, 1.0, 10.0)
    vertices, faces = terrain.triangles()
    x, y = np.random.default_rng(1).uniform(-4.9, 4.9, (2, 200))
    client = pybullet.connect(pybullet.DIRECT)
    try:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=faces.ravel().tolist(),
            physicsClientId=client,
        )
        pybullet.createMultiBody(0.0, shape, physicsClientId=client)
        starts, ends = np.stack([x, y, np.full(200, 2.0)], 1), np.stack([x, y, np.full(200, -2.0)], 1)
        hits = pybullet.rayTestBatch(starts.tolist(), ends.tolist(), physicsClientId=client)
    finally:
        pybullet.disconnect(physicsClientId=client)
    np.testing.assert_allclose(terrain.height(x, y), [hit[3][2] for hit in hits], atol=1e-5)


def test_beyond_a_side_the_height_is_that_of_the_side() -> None:
    terrain = Terrain(np.arange(9.0).reshape(3, 3), 1.0)
    assert terrain.height(5.0, 0.0) == terrain.height(1.0, 0.0) == 7.0


@pytest.mark.parametrize("difficulty", [-0.1, 1.51, float("nan")])
def test_a_difficulty_outside_its_range_is_refused(difficulty: float) -> None:
    with pytest.raises(TerrainError, match=r"must lie in \[0, 1.5\]"):
        generate(0, difficulty)


def test_a_ground_smaller_than_a_cell_is_refused() -> None:
    with pytest.raises(TerrainError, match="m wide"):
        generate(0, 1.0, 0.1)


def test_the_normal_stands_on_the_triangle_below() -> None:
    rng, ground = np.random.default_rng(1), generate(2, 1.0)
    x, y = rng.uniform(-15, 15, (2, 100))
    step = 1e-7
    normal = ground.normal(x, y)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    slopes = [(ground.height(x + dx, y + dy) - ground.height(x, y)) / step for dx, dy in ((step, 0.0), (0.0, step))]
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], np.transpose(slopes), atol=1e-6)
    np.testing.assert_allclose(np.degrees(np.arccos(normal[:, 2])), ground.slope_deg(x, y))
