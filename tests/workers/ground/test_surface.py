"""Laws of grounds from files, inclines and fences."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.ground import FENCE_HEIGHT_M, fenced, ground, tilted
from t6gps.workers.ground.surface import LARGEST_FILE_BYTES, load
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.settings import RobotSettings, TerrainSettings

HILLS = generate(4, 1.0, 10.0)


def surface(path: Path, terrain: Terrain = HILLS) -> Path:
    vertices, faces = terrain.triangles()
    trimesh.Trimesh(vertices, faces, process=False).export(path)
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


def saved(path: Path, heights: object) -> Path:
    np.save(path, np.asarray(heights))
    return path


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def picture(path: Path, grey: NDArray[np.generic]) -> Path:
    Image.fromarray(grey).save(path)
    return path


def cut(path: Path, bytes_n: int) -> Path:
    """The file without its last bytes."""
    return written(path, path.read_bytes()[:-bytes_n])


def flipped(path: Path, place: int) -> Path:
    content = bytearray(path.read_bytes())
    content[place] ^= 0x10
    return written(path, bytes(content))


def vast(path: Path) -> Path:
    """A picture that says it has 20,000 x 20,000 pixels."""
    content = path.read_bytes()
    return written(path, content[:16] + 2 * (20000).to_bytes(4, "big") + content[24:])


def archive(path: Path) -> Path:
    with path.open("wb") as file:
        np.savez(file, heights=HILLS.heights)
    return path


def header(path: Path, shape: tuple[int, ...]) -> Path:
    """An .npy that announces heights of this shape and holds eight bytes."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
        file.write(bytes(8))
    return path


def sparse(path: Path, bytes_n: int) -> Path:
    with path.open("wb") as file:
        file.truncate(bytes_n)
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def unreadable(path: Path) -> Path:
    """A file that exists, for a superuser too, and cannot be read: the first page of memory is never there."""
    path.symlink_to("/proc/self/mem")
    return path


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


GREY = (np.add.outer(np.arange(21), np.arange(21)) * 6).astype(np.uint8)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: d / "map.tif", ["'.tif'", ".npy, .png, .stl, .obj"]),
        (lambda d: d / "missing.npy", ["no file", "correct terrain.file"]),
        (lambda d: d / ("x" * 300 + ".npy"), ["File name too long"]),
        (lambda d: d / "nul\0.npy", ["null"]),
        (lambda d: folder(d / "folder.npy"), ["is a folder"]),
        (lambda d: unreadable(d / "unreadable.npy"), ["Input/output error; give access"]),
        (lambda d: pipe(d / "pipe.npy"), ["a device or a pipe"]),
        (lambda d: sparse(d / "vast.stl", LARGEST_FILE_BYTES + 1), ["more than 16 MiB"]),
        (lambda d: written(d / "empty.npy", b""), ["is empty"]),
        (lambda d: written(d / "broken.npy", b"not a file of this kind"), ["is damaged, or no .npy file", "anew"]),
        (lambda d: written(d / "broken.png", b"not a file of this kind"), ["not a picture"]),
        (lambda d: archive(d / "archive.npy"), ["archive of arrays (.npz)", "numpy.save"]),
        (lambda d: cut(saved(d / "head.npy", HILLS.heights), 21 * 21 * 8 + 60), ["is damaged", "header"]),
        (lambda d: cut(saved(d / "cut.npy", HILLS.heights), 8), ["take 3528 bytes, found 3520"]),
        (lambda d: header(d / "vast.npy", (10**6, 10**6)), ["1000000 x 1000000", "1e-05 m apart"]),
        (lambda d: header(d / "claims.npy", (90, 90)), ["take 64800 bytes, found 8"]),
        (lambda d: saved(d / "text.npy", [["a"]]), ["real numbers"]),
        (lambda d: saved(d / "objects.npy", np.full((21, 21), None)), ["real numbers"]),
        (lambda d: saved(d / "long.npy", np.zeros((5, 9))), ["square", "[5, 9]"]),
        (lambda d: saved(d / "nan.npy", np.full((21, 21), np.nan)), ["441 heights are not finite", "[0, 0]"]),
        (lambda d: saved(d / "coarse.npy", np.zeros((4, 4))), ["3.33 m apart", "terrain.size_m"]),
        (lambda d: saved(d / "steep.npy", 20 * HILLS.heights), ["cannot be stood on"]),
        (lambda d: cut(picture(d / "cut.png", GREY), 30), ["is damaged", "save or export it anew"]),
        (lambda d: flipped(picture(d / "flipped.png", GREY), 60), ["is damaged"]),
        (lambda d: vast(picture(d / "vast.png", GREY)), ["20000 x 20000", "0.0005 m apart"]),
        (lambda d: picture(d / "colour.png", np.zeros((21, 21, 3), np.uint8)), ["grey", "RGB"]),
    ],
)  # fmt: skip
def test_a_file_that_is_no_ground_is_refused_with_its_name_and_the_cause(
    tmp_path: Path, make: Callable[[Path], Path], words: list[str]
) -> None:
    path = make(tmp_path)
    with pytest.raises(TerrainError) as error:
        load(path, 10.0, 1.55)
    for word in [path.name, *words]:
        assert word in str(error.value)


def test_no_flipped_byte_of_a_picture_passes_for_other_heights(tmp_path: Path) -> None:
    whole = picture(tmp_path / "map.png", GREY)
    expected = load(whole, 10.0, 1.55).heights
    for place in range(len(whole.read_bytes())):
        damaged = flipped(written(tmp_path / f"{place}.png", whole.read_bytes()), place)
        try:
            assert np.array_equal(load(damaged, 10.0, 1.55).heights, expected)
        except TerrainError:
            continue


def test_a_file_that_was_changed_is_read_again(tmp_path: Path) -> None:
    path = saved(tmp_path / "map.npy", HILLS.heights)
    load(path, 10.0, 1.55)
    changed = saved(path, np.tile(HILLS.heights, (2, 2))[:31, :31])
    assert len(load(changed, 10.0, 1.55).heights) == 31


def test_the_ground_of_a_file_cannot_be_written_over(tmp_path: Path) -> None:
    read = load(saved(tmp_path / "map.npy", HILLS.heights), 10.0, 1.55)
    with pytest.raises(ValueError, match="read-only"):
        read.heights[0, 0] = 1.0


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
