"""Rough ground with the statistics of the paper (Sec. IV-A): random hills on a square grid, two triangles per cell.

Heights are white noise, blurred by a Gaussian, scaled to a standard deviation of 0.50 m and clipped at +-0.775 m; at
difficulty 1 the facets then slope by 38.2 deg on average (standard deviation 16 deg) over a range of 1.55 m.
Difficulty scales both numbers together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from t6gps.storage.errors import TerrainError
from t6gps.workers.robot.state import Array
from t6gps.workers.settings import STEEPEST_DIFFICULTY

CELL_M = 0.5
"""A quarter of a bar: facets are smaller than the support triangle and larger than a foot."""

BLUR_STD_M = 0.41
"""Chosen with the two below for the paper's slopes: 38 deg on average, standard deviation 16 deg."""

HEIGHT_STD_M = 0.50
LARGEST_HEIGHT_M = 0.775
"""Half the paper's range of heights."""


@dataclass(frozen=True)
class Terrain:
    """A height field centred at the origin; heights[i, j] (m) [n, n] stands at x = (i - (n-1)/2) cell_m, y likewise."""

    heights: Array
    cell_m: float

    @property
    def half_size_m(self) -> float:
        """Distance from the centre to each side of the square (m)."""
        return (len(self.heights) - 1) / 2 * self.cell_m

    def height(self, x: Array | float, y: Array | float) -> Array:
        """Height (m) of the triangles at x, y (m, equal shapes); beyond the sides, that of the nearest side."""
        corner, over_x, over_y, far, a, b = self._cells(x, y)
        below = corner + a * (over_x - corner) + b * (far - over_x)
        above = corner + b * (over_y - corner) + a * (far - over_y)
        return np.asarray(np.where(a >= b, below, above))

    def slope_deg(self, x: Array | float, y: Array | float) -> Array:
        """Slope (deg) of the triangles at x, y (m, equal shapes); beyond the sides, that of the nearest side."""
        corner, over_x, over_y, far, a, b = self._cells(x, y)
        below = np.hypot(over_x - corner, far - over_x)
        above = np.hypot(over_y - corner, far - over_y)
        return np.degrees(np.arctan(np.where(a >= b, below, above) / self.cell_m))

    def normal(self, x: Array | float, y: Array | float) -> Array:
        """Upward unit normals [..., 3] of the triangles at x, y (m, equal shapes); beyond the sides, as `height`."""
        corner, over_x, over_y, far, a, b = self._cells(x, y)
        rise_x = np.where(a >= b, over_x - corner, far - over_y)
        rise_y = np.where(a >= b, far - over_x, over_y - corner)
        normal = np.stack([-rise_x, -rise_y, np.full_like(rise_x, self.cell_m)], axis=-1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def _cells(self, x: Array | float, y: Array | float) -> tuple[Array, ...]:
        """Heights of the cells' four corners, and the shares of the way over x and y.

        The diagonal of a cell runs from its corner to the far corner; a point lies on the side of the larger share.
        """
        last = len(self.heights) - 1
        u = np.clip(np.asarray(x, dtype=float) / self.cell_m + last / 2, 0, last)
        v = np.clip(np.asarray(y, dtype=float) / self.cell_m + last / 2, 0, last)
        i = np.minimum(u.astype(int), last - 1)
        j = np.minimum(v.astype(int), last - 1)
        corner, far = self.heights[i, j], self.heights[i + 1, j + 1]
        return corner, self.heights[i + 1, j], self.heights[i, j + 1], far, u - i, v - j

    def triangles(self) -> tuple[Array, np.ndarray[tuple[int, int], np.dtype[np.int64]]]:
        """Vertices [n^2, 3] (m) and vertex numbers of the triangles [2 (n-1)^2, 3], anticlockwise from above."""
        n = len(self.heights)
        line = (np.arange(n) - (n - 1) / 2) * self.cell_m
        x, y = np.meshgrid(line, line, indexing="ij")
        vertices = np.stack([x, y, self.heights], axis=-1).reshape(-1, 3)
        number = np.arange(n * n).reshape(n, n)
        corner, over_x = number[:-1, :-1], number[1:, :-1]
        over_y, far = number[:-1, 1:], number[1:, 1:]
        faces = np.stack([corner, over_x, far, corner, far, over_y], axis=-1)
        return vertices, faces.reshape(-1, 3)

    def statistics(self) -> tuple[float, float, float]:
        """Mean facet slope (deg), its standard deviation (deg) and the range of heights (m)."""
        vertices, faces = self.triangles()
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slopes = np.degrees(np.arctan2(np.hypot(normals[:, 0], normals[:, 1]), normals[:, 2]))
        return float(slopes.mean()), float(slopes.std()), float(np.ptp(self.heights))


def _blurred_noise(rng: np.random.Generator, n: int) -> Array:
    """White noise [n, n] under a separable Gaussian; drawn with a margin, so that the sides look like the middle."""
    width = int(np.ceil(4 * BLUR_STD_M / CELL_M))
    kernel = np.exp(-0.5 * (np.arange(-width, width + 1) * CELL_M / BLUR_STD_M) ** 2)
    noise = rng.standard_normal((n + 2 * width, n + 2 * width))
    windows = np.lib.stride_tricks.sliding_window_view
    return np.asarray(windows(windows(noise, len(kernel), axis=0) @ kernel, len(kernel), axis=1) @ kernel)


def generate(seed: int, difficulty: float, size_m: float = 40.0) -> Terrain:
    """The ground of a seed: flat at difficulty 0, the paper's at 1.

    Raises TerrainError for a difficulty outside [0, 1.5] or a size outside [0.5, 100] m.
    """
    if not 0.0 <= difficulty <= STEEPEST_DIFFICULTY:
        raise TerrainError(
            f"terrain.difficulty must lie in [0, {STEEPEST_DIFFICULTY}], got {difficulty}; "
            "0 is flat, 1 has the paper's 38 deg slopes"
        )
    if not CELL_M <= size_m <= 100.0:
        raise TerrainError(f"the ground must be {CELL_M} to 100 m wide, got {size_m}; the default is 40")
    noise = _blurred_noise(np.random.default_rng(seed), round(size_m / CELL_M) + 1)
    heights = np.clip(noise * (HEIGHT_STD_M / noise.std()), -LARGEST_HEIGHT_M, LARGEST_HEIGHT_M)
    return Terrain(difficulty * heights, CELL_M)
