"""A ground as a page draws it: heights on a grid, rounded to 0.1 mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures.viewer.ground_mesh import REACH_M

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """A ground, or a part of it: heights [rows, columns] (m) at x_m + i cell_m, y_m + j cell_m.

    The diagonal of a cell runs from (i, j) to (i + 1, j + 1).
    """

    x_m: float
    y_m: float
    cell_m: float
    rows: int
    columns: int
    heights_m: list[float]


def around(terrain: Terrain, path: Array) -> Ground:
    """The part of a ground that one sees from a path [n, 2] (m)."""
    middle = (len(terrain.heights) - 1) / 2
    low = np.floor((path.min(axis=0) - REACH_M) / terrain.cell_m + middle).astype(int).clip(0, len(terrain.heights) - 2)
    high = np.ceil((path.max(axis=0) + REACH_M) / terrain.cell_m + middle).astype(int) + 1
    heights = terrain.heights[low[0] : max(high[0], low[0] + 2), low[1] : max(high[1], low[1] + 2)]
    return _ground(heights, (low - middle) * terrain.cell_m, terrain.cell_m)


def whole(terrain: Terrain) -> Ground:
    """All of a ground."""
    return _ground(terrain.heights, np.full(2, -terrain.half_size_m), terrain.cell_m)


def _ground(heights: Array, corner: Array, cell_m: float) -> Ground:
    x_m, y_m = corner.tolist()
    rows, columns = heights.shape
    return Ground(x_m, y_m, cell_m, rows, columns, rounded(heights, 4))


def rounded(values: Array, decimals: int) -> list[float]:
    """All numbers of an array in one list."""
    flat: list[float] = np.round(values, decimals).ravel().tolist()
    return flat
