"""Ground from a file: a height map (.npy, .png) or a triangulated surface (.stl, .obj), put on a square grid.

.npy         heights (m) [n, n], first axis x, second y
.png         grey values, 8 or 16 bit, square; the image lies as a map: x to the right, y up, white is high
.stl, .obj   triangles (m); seen from above they must cover the square around the middle of their bounding box

A file gives ground or one TerrainError. `height_maps` and `meshes` read, `draping` puts triangles on the grid, and
`sense` refuses what no robot can stand on and doubts what nobody is likely to want.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from stat import S_ISDIR, S_ISREG

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.draping import drape
from t6gps.workers.ground.height_maps import npy, png
from t6gps.workers.ground.meshes import obj, stl
from t6gps.workers.ground.sense import check_extent, check_grid, check_heights
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.state import Array
from t6gps.workers.settings import Doubt

SUFFIXES = (".npy", ".png", ".stl", ".obj")

LARGEST_FILE_BYTES = 16 * 2**20
"""Room for the finest map of the widest ground, and for as many triangles as a binary .stl may have."""


def load(path: Path, size_m: float, png_range_m: float, accept: tuple[Doubt, ...] = ()) -> Terrain:
    """The ground of a file, `size_m` wide; `png_range_m` is the height (m) between black and white of a .png.

    Raises TerrainError for a file that is missing, unreadable, damaged or too large, of another kind or shape, not
    finite, with holes, too coarse or too fine, too steep to stand on, or doubtful in a way that `accept` does not name.
    The heights are read-only.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise TerrainError(f"cannot read ground from {path}: found '{path.suffix}'; allowed: {', '.join(SUFFIXES)}")
    try:
        found = path.stat()
    except FileNotFoundError:
        raise TerrainError(f"there is no file {path} to read ground from; correct terrain.file") from None
    except (OSError, ValueError) as error:
        raise TerrainError(f"cannot look for ground at {path}: {_reason(error)}; correct terrain.file") from None
    if not S_ISREG(found.st_mode):
        kind = "a folder" if S_ISDIR(found.st_mode) else "a device or a pipe"
        raise TerrainError(f"{path} is {kind}, not a file with ground; correct terrain.file")
    return _loaded(path, (found.st_mtime_ns, found.st_size), size_m, png_range_m, accept)


@lru_cache(maxsize=4)
def _loaded(
    path: Path, _stamp: tuple[int, int], size_m: float, png_range_m: float, accept: tuple[Doubt, ...]
) -> Terrain:
    content = _content(path)
    try:
        heights = _heights(path.suffix.lower(), content, size_m, png_range_m, accept)
        terrain = Terrain(heights, size_m / (len(heights) - 1))
        check_heights(terrain, accept)
    except TerrainError as error:
        raise TerrainError(f"{path}: {error}") from error
    except Exception as error:  # the readers of numpy and Pillow raise whatever their parsing meets
        raise TerrainError(
            f"{path} is damaged, or no {path.suffix.lower()} file: {_reason(error)}; save or export it anew"
        ) from error
    terrain.heights.flags.writeable = False
    return terrain


def _content(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise TerrainError(f"cannot read ground from {path}: {_reason(error)}; give access to the file") from None
    if len(content) > LARGEST_FILE_BYTES:
        raise TerrainError(
            f"{path} holds more than {LARGEST_FILE_BYTES // 2**20} MiB, the most that a ground's file may hold; "
            "resample the map or simplify the surface"
        )
    if not content:
        raise TerrainError(f"{path} is empty; save or export it anew")
    return content


def _heights(suffix: str, content: bytes, size_m: float, png_range_m: float, accept: tuple[Doubt, ...]) -> Array:
    if suffix == ".npy":
        return npy(content, lambda shape: check_grid(shape, size_m))
    if suffix == ".png":
        return png(content, lambda shape: check_grid(shape, size_m), png_range_m)
    corners = stl(content) if suffix == ".stl" else obj(content)
    check_extent(corners, size_m, accept)
    return drape(corners, size_m)


def _reason(error: Exception) -> str:
    """What an error of a library says, in one short line."""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
    return " ".join(text.split())[:150]
