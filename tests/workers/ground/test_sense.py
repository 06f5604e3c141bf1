"""Laws of the sense of a ground: impossible is refused, doubtful is refused until the doubt is accepted by name."""

from pathlib import Path

import numpy as np
import pytest

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.draping import drape
from t6gps.workers.ground.ground import ground
from t6gps.workers.ground.sense import check_extent, check_heights
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.robot.state import Array
from t6gps.workers.settings import Doubt, TerrainSettings

VERTICES, FACES = generate(4, 1.0, 10.0).triangles()
SURFACE = VERTICES[FACES]
HEIGHTS = generate(4, 1.0, 10.0).heights


def with_height(value: float) -> Array:
    heights = HEIGHTS.copy()
    heights[7, 3] = value
    return heights


@pytest.mark.parametrize(
    ("doubt", "heights", "words"),
    [
        ("range", with_height(12.0), "heights range over 12.7"),
        ("step", with_height(3.0), r"from the height at \[[67], [23]\] to its neighbour along [xy] it is [23]\."),
        ("flat", np.full((21, 21), 3.0), "all heights are equal"),
    ],
)
def test_doubtful_heights_are_refused_until_the_doubt_is_accepted(doubt: Doubt, heights: Array, words: str) -> None:
    others: tuple[Doubt, ...] = tuple(name for name in ("extent", "range", "step", "flat") if name != doubt)
    terrain = Terrain(heights, 0.5)
    with pytest.raises(TerrainError, match=words) as error:
        check_heights(terrain, others)
    assert f'terrain.accept = ["{others[0]}", "{others[1]}", "{others[2]}", "{doubt}"]' in str(error.value)
    check_heights(terrain, (*others, doubt))


def test_a_surface_in_millimetres_is_not_cut_out_in_silence() -> None:
    with pytest.raises(TerrainError, match=r"10000 x 10000 m.*small piece.*terrain\.accept = \[\"extent\"\]"):
        check_extent(1000 * SURFACE, 10.0, ())
    check_extent(1000 * SURFACE, 10.0, ("extent",))
    check_extent(2 * SURFACE, 10.0, ())


def test_heights_in_millimetres_and_above_the_sea_are_refused() -> None:
    for heights in (1000 * HEIGHTS, HEIGHTS + 1200):
        with pytest.raises(TerrainError, match="allowed: -500 to 500 m; save them in metres, and subtract their mean"):
            check_heights(Terrain(heights, 0.5), ())


@pytest.mark.parametrize("value", [1e300, -1e300, np.inf])
def test_no_height_is_too_large_to_be_refused(value: float) -> None:
    with pytest.raises(TerrainError):
        check_heights(Terrain(with_height(value), 0.5), ("extent", "range", "step", "flat"))


def test_a_surface_whose_y_is_up_is_told_so() -> None:
    with pytest.raises(TerrainError, match="export it with z up"):
        check_extent(SURFACE[:, :, [0, 2, 1]], 10.0, ())
    with pytest.raises(TerrainError, match="scale the surface to metres"):
        check_extent(SURFACE / 1000, 10.0, ())


def turned(corners: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        (SURFACE[(FACES != 220).all(axis=1)], "1 of 441 .* all of them inside; close them"),
        (SURFACE[:-30], "on the sides of the square of 10 m, which the surface does not fill"),
        (turned(SURFACE, np.pi / 4), "on the sides of the square"),
        (np.concatenate([SURFACE[:-30], SURFACE[:5][:, [0, 0, 0]]]), "5 of 775 triangles are upright or have no area"),
        (np.stack([SURFACE[:, k] * [1, 0, 1] for k in range(3)], axis=1), "none of the 800 triangles has an area"),
        (np.tile([[[-1e5, -1e5, 0], [1e5, -1e5, 0], [0, 2e5, 0]]], (30000, 1, 1)), "more than 11337 layers"),
    ],
)
def test_holes_are_told_by_their_cause(corners: Array, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        drape(corners, 10.0)


def test_an_overhang_is_no_hole_and_upright_walls_do_no_harm() -> None:
    wall = SURFACE[:5] * [1, 0, 1]
    roof = SURFACE[100:120] + [0, 0, 0.5]
    assert (drape(np.concatenate([SURFACE, wall, roof]), 10.0) >= HEIGHTS - 1e-9).all()


def test_what_a_file_must_accept_is_a_setting(tmp_path: Path) -> None:
    file = str(tmp_path / "map.npy")
    np.save(file, np.zeros((81, 81)))
    with pytest.raises(TerrainError, match=r"map\.npy: all heights are equal"):
        ground(TerrainSettings(file=file), 0, 0.0)
    accepted = ground(TerrainSettings(file=file, accept=("flat",)), 0, 0.0)
    assert accepted is not None
    assert np.ptp(accepted.heights[1:-1, 1:-1]) == 0
