"""Ground from a file: a height map (.npy, .png) or a triangulated surface (.stl, .obj), put on a square grid.

.npy         heights (m) [n, n], first axis x, second y
.png         grey values, 8 or 16 bit, square; the image lies as a map: x to the right, y up, white is high
.stl, .obj   triangles (m); seen from above they must cover the square around the middle of their bounding box
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, UnidentifiedImageError

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.terrain import CELL_M, Terrain
from t6gps.workers.robot.state import Array

FINEST_CELL_M = 0.1
"""As wide as a bar."""

COARSEST_CELL_M = 2.0
"""As long as a bar."""

STEEPEST_MEAN_SLOPE_DEG = 60.0
"""Ground that is steeper on average cannot be stood on."""


@lru_cache(maxsize=4)
def load(path: Path, size_m: float, png_range_m: float) -> Terrain:
    """The ground of a file, `size_m` wide; `png_range_m` is the height (m) between black and white of a .png.

    Raises TerrainError for a file that is missing, of another kind or shape, not finite, with holes, too coarse or
    too fine, or too steep to stand on.
    """
    readers = {".npy": _height_map, ".png": _picture, ".stl": _surface, ".obj": _surface}
    if path.suffix.lower() not in readers:
        raise TerrainError(f"cannot read ground from {path}: found '{path.suffix}'; allowed: {', '.join(readers)}")
    if not path.is_file():
        raise TerrainError(f"there is no file {path} to read ground from; correct terrain.file")
    heights = readers[path.suffix.lower()](path, size_m, png_range_m)
    if heights.ndim != 2 or heights.shape[0] != heights.shape[1] or len(heights) < 3:
        raise TerrainError(f"{path}: a height map must be square, at least 3 x 3, found {list(heights.shape)}; crop it")
    if not np.isfinite(heights).all():
        i, j = np.argwhere(~np.isfinite(heights))[0]
        raise TerrainError(
            f"{path}: {np.count_nonzero(~np.isfinite(heights))} heights are not finite, "
            f"the first at [{i}, {j}]; fill them"
        )
    terrain = Terrain(heights, size_m / (len(heights) - 1))
    if not FINEST_CELL_M <= terrain.cell_m <= COARSEST_CELL_M:
        raise TerrainError(
            f"{path}: {len(heights)} heights over {size_m} m are {terrain.cell_m:.3g} m apart; "
            f"allowed: {FINEST_CELL_M} to {COARSEST_CELL_M} m; change terrain.size_m or resample the map"
        )
    slope_deg = terrain.statistics()[0]
    if slope_deg > STEEPEST_MEAN_SLOPE_DEG:
        raise TerrainError(
            f"{path}: the ground slopes by {slope_deg:.0f} deg on average and cannot be stood on; allowed: up to "
            f"{STEEPEST_MEAN_SLOPE_DEG:.0f} deg; lower its heights (in metres) or enlarge terrain.size_m"
        )
    return terrain


def _height_map(path: Path, _size_m: float, _png_range_m: float) -> Array:
    try:
        heights = np.load(path, allow_pickle=False)
    except ValueError as error:
        raise TerrainError(f"{path} is not an array of numbers: {error}; save it with numpy.save") from None
    if not np.issubdtype(heights.dtype, np.number) or np.iscomplexobj(heights):
        raise TerrainError(f"{path}: heights must be real numbers, found {heights.dtype}")
    return heights.astype(np.float64)


def _picture(path: Path, _size_m: float, png_range_m: float) -> Array:
    try:
        with Image.open(path) as image:
            mode, grey = image.mode, np.asarray(image, dtype=np.float64)
    except UnidentifiedImageError as error:
        raise TerrainError(f"{path} is not a picture: {error}") from None
    whites = {"L": 255.0, "I;16": 65535.0, "I": 65535.0}
    if mode not in whites:
        raise TerrainError(f"{path}: a height map must be grey with 8 or 16 bits, found mode {mode}; convert it")
    return np.ascontiguousarray(grey[::-1].T) * (png_range_m / whites[mode])


def _surface(path: Path, size_m: float, _png_range_m: float) -> Array:
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # the readers of trimesh raise whatever their parsing meets
        raise TerrainError(f"{path} is not a readable surface: {error}") from error
    if not len(mesh.faces):
        raise TerrainError(f"{path} holds no triangles")
    corners = np.array(mesh.triangles, dtype=np.float64)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    width, depth = high[:2] - low[:2]
    if min(width, depth) < size_m - 1e-6:
        raise TerrainError(
            f"{path}: the surface is {width:.2f} x {depth:.2f} m, smaller than the ground of {size_m} m; "
            "set terrain.size_m, or scale the surface to metres"
        )
    corners[:, :, :2] -= (low + high)[:2] / 2
    heights = _drape(corners, size_m)
    holes = np.argwhere(np.isnan(heights))
    if len(holes):
        x, y = holes[0] * CELL_M - size_m / 2
        raise TerrainError(
            f"{path}: the surface has holes: {len(holes)} of {heights.size} points of the grid lie over none of its "
            f"triangles, the first at x = {x:.2f} m, y = {y:.2f} m from its middle; close them"
        )
    return heights


def _drape(corners: Array, size_m: float) -> Array:
    """Largest height of the triangles [m, 3, 3] at each point of the grid [n, n], NaN where there is none."""
    n = round(size_m / CELL_M) + 1
    heights = np.full((n, n), np.nan)
    places = corners[:, :, :2] / CELL_M + (n - 1) / 2
    firsts = np.maximum(np.ceil(places.min(axis=1) - 1e-9).astype(int), 0)
    lasts = np.minimum(np.floor(places.max(axis=1) + 1e-9).astype(int), n - 1)
    for (a, b, c), z, first, last in zip(places, corners[:, :, 2], firsts, lasts, strict=True):
        twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if twice_area == 0 or (last < first).any():
            continue
        i, j = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1), indexing="ij")
        of_b = ((i - a[0]) * (c[1] - a[1]) - (j - a[1]) * (c[0] - a[0])) / twice_area
        of_c = ((b[0] - a[0]) * (j - a[1]) - (b[1] - a[1]) * (i - a[0])) / twice_area
        inside = (of_b >= -1e-9) & (of_c >= -1e-9) & (of_b + of_c <= 1 + 1e-9)
        height = z[0] + of_b * (z[1] - z[0]) + of_c * (z[2] - z[0])
        heights[i[inside], j[inside]] = np.fmax(heights[i[inside], j[inside]], height[inside])
    return heights
