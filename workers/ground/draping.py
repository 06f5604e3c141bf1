"""A surface of triangles put on the grid of the ground: of all triangles over a point, the highest counts."""

from __future__ import annotations

import numpy as np

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.meshes import upward_areas
from t6gps.workers.ground.terrain import CELL_M
from t6gps.workers.robot.state import Array

MOST_VISITS_N = 5_000_000
"""Points within the bounding boxes of all triangles, summed: a grid of 40 m under 760 layers takes a second."""

CHUNK_VISITS_N = 200_000
"""Visited at a time, so that memory stays small."""


def drape(corners: Array, size_m: float) -> Array:
    """Heights (m) [n, n] of a surface [m, 3, 3] (m) on the square around the middle of its bounding box.

    Raises TerrainError, by cause, where the surface has holes, and where its triangles lie in too many layers.
    """
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    centred = corners.copy()
    centred[:, :, :2] -= (low + high)[:2] / 2
    heights = _highest(centred, size_m)
    _check_covered(heights, corners, size_m)
    return heights


def _highest(corners: Array, size_m: float) -> Array:
    """Largest height of the triangles at each point of the grid [n, n], NaN where there is none."""
    n = round(size_m / CELL_M) + 1
    heights = np.full((n, n), np.nan)
    places = corners[:, :, :2] / CELL_M + (n - 1) / 2
    firsts = np.clip(np.ceil(places.min(axis=1) - 1e-9), 0, n).astype(int)
    lasts = np.clip(np.floor(places.max(axis=1) + 1e-9), -1, n - 1).astype(int)
    widths = np.maximum(lasts - firsts + 1, 0)
    visits = widths.prod(axis=1) * (upward_areas(places) != 0)
    if visits.sum() > MOST_VISITS_N:
        raise TerrainError(
            f"the {len(corners)} triangles lie in more than {MOST_VISITS_N // n**2} layers over the grid, or are long "
            "splinters; simplify the surface"
        )
    seen = np.flatnonzero(visits)
    ends = np.cumsum(visits[seen])
    for chunk in np.split(seen, np.flatnonzero(np.diff(ends // CHUNK_VISITS_N)) + 1):
        _raise_to(heights, places[chunk], corners[chunk, :, 2], firsts[chunk], widths[chunk])
    return heights


def _raise_to(heights: Array, places: Array, z: Array, firsts: Array, widths: Array) -> None:
    """Raise the heights under these triangles [k, 3, 2] (cells) with heights `z` [k, 3] (m) of their corners."""
    visits = widths.prod(axis=1)
    triangle = np.repeat(np.arange(len(places)), visits)
    place = np.arange(len(triangle)) - np.repeat(np.cumsum(visits) - visits, visits)
    i = firsts[triangle, 0] + place // widths[triangle, 1]
    j = firsts[triangle, 1] + place % widths[triangle, 1]
    a, b, c = (places[triangle, k].T for k in range(3))
    twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    of_b = ((i - a[0]) * (c[1] - a[1]) - (j - a[1]) * (c[0] - a[0])) / twice_area
    of_c = ((b[0] - a[0]) * (j - a[1]) - (b[1] - a[1]) * (i - a[0])) / twice_area
    inside = (of_b >= -1e-9) & (of_c >= -1e-9) & (of_b + of_c <= 1 + 1e-9)
    of_a, z_b, z_c = (z[triangle, k] for k in range(3))
    height = of_a + of_b * (z_b - of_a) + of_c * (z_c - of_a)
    np.fmax.at(heights, (i[inside], j[inside]), height[inside])


def _check_covered(heights: Array, corners: Array, size_m: float) -> None:
    """TerrainError where points of the grid have no height, with the cause."""
    holes = np.isnan(heights)
    if not holes.any():
        return
    upright_n = np.count_nonzero(upward_areas(corners) == 0)
    if upright_n == len(corners):
        raise TerrainError(
            f"none of the {len(corners)} triangles has an area seen from above; export the surface with z up"
        )
    inner = holes[1:-1, 1:-1]
    sides_n = np.count_nonzero(holes) - np.count_nonzero(inner)
    x, y = np.argwhere(holes)[0] * CELL_M - size_m / 2
    cause = (
        f"{sides_n} of them on the sides of the square of {size_m:g} m, which the surface does not fill; make it "
        "square, turn it along x and y, or set a smaller terrain.size_m"
        if sides_n
        else "all of them inside; close them"
    )
    upright = f" ({upright_n} of {len(corners)} triangles are upright or have no area)" if upright_n else ""
    raise TerrainError(
        f"the surface has holes: {np.count_nonzero(holes)} of {heights.size} points of the grid lie over none of its "
        f"triangles{upright}, the first at x = {x:.2f} m, y = {y:.2f} m from its middle; {cause}"
    )
