"""How the ground looks: facets under the sun, shadows of the hills, height tint and contour lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures.raycast import look_up

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

FINE_M = 0.1
"""Cell of the grid on which shadows of the hills are computed."""

SHADOW_REACH_M = 4.0
"""How far towards the sun hills are looked for."""

CONTOUR_STEP_M = 0.25
"""Height between two contour lines."""

GRID_STEP_M = 1.0
"""Between two lines of the grid on flat ground."""

LINE_HALF_WIDTH_M = 0.006
"""Of both kinds of lines."""

LOWEST_M = -0.8
"""Height of the first of TINTS: the lowest ground of difficulty 1."""

HIGHEST_M = 0.8
"""Height of the last of TINTS."""

TINTS = np.array([[0.05, 0.11, 0.13], [0.14, 0.19, 0.14], [0.40, 0.31, 0.19], [0.72, 0.62, 0.47]])
"""Albedo from the lowest to the highest ground."""
FLAT_TINT = np.array([0.33, 0.33, 0.29], np.float32)


class Landscape:
    """A ground (None: flat) under a sun in the direction of the unit vector `sun` [3]."""

    def __init__(self, terrain: Terrain | None, sun: Array) -> None:
        self._terrain, self._sun = terrain, sun
        self.creases = _creases(terrain)
        if terrain is None:
            return
        self._tints = tint(np.linspace(LOWEST_M, HIGHEST_M, 256)).astype(np.float32)
        vertices, faces = terrain.triangles()
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self._lambert = np.clip(normals @ sun, 0, 1).astype(np.float32)
        self._skyward = (0.5 + 0.5 * normals[:, 2]).astype(np.float32)
        self._gradient = np.maximum(np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2], 0.05).astype(np.float32)
        self._sunlit, self._open_sky = self._fields(terrain)

    def height(self, x: Array | float, y: Array | float) -> Array:
        """Height of the ground (m)."""
        return np.zeros(np.shape(x)) if self._terrain is None else self._terrain.height(x, y)

    def _fields(self, terrain: Terrain) -> tuple[Floats, Floats]:
        """Share of the sun and of the sky that hills leave, on a fine grid."""
        n = round(2 * terrain.half_size_m / FINE_M) + 1
        line = np.linspace(-terrain.half_size_m, terrain.half_size_m, n)
        x, y = np.meshgrid(line, line, indexing="ij")
        height = terrain.height(x, y)
        across = self._sun[:2] / np.hypot(*self._sun[:2])
        climb = self._sun[2] / np.hypot(*self._sun[:2])
        hidden = np.full_like(height, -1.0)
        for way in np.arange(FINE_M, SHADOW_REACH_M, FINE_M):
            rise = terrain.height(x + way * across[0], y + way * across[1]) - way * climb - height
            np.maximum(hidden, rise - 0.03 * way, out=hidden)
        sunlit = np.clip(0.5 - hidden / 0.08, 0, 1)
        width = round(0.7 / FINE_M)
        windows = np.lib.stride_tricks.sliding_window_view
        padded = np.pad(height, width, mode="edge")
        around = windows(windows(padded, 2 * width + 1, axis=0).mean(axis=-1), 2 * width + 1, axis=1).mean(axis=-1)
        return sunlit.astype(np.float32), np.clip(0.8 + 0.9 * (height - around), 0.35, 1.1).astype(np.float32)

    def shade(self, x: Floats, y: Floats, z: Floats, pixel: Floats) -> tuple[Floats, Floats, Floats]:
        """Direct light [m], light of the sky [m] and albedo [m, 3] of ground points; `pixel` is their size (m)."""
        if self._terrain is None:
            direct, ambient = np.full(len(x), self._sun[2], np.float32), np.ones(len(x), np.float32)
            albedo = np.tile(FLAT_TINT, (len(x), 1))
            gap = np.minimum(*(np.abs(p / GRID_STEP_M - np.rint(p / GRID_STEP_M)) * GRID_STEP_M for p in (x, y)))
            return direct, ambient, albedo * (1 - 0.35 * _line(gap, pixel))[:, None]
        n, cell = len(self._terrain.heights), self._terrain.cell_m
        u = np.clip(x / cell + (n - 1) / 2, 0, n - 1.001)
        v = np.clip(y / cell + (n - 1) / 2, 0, n - 1.001)
        i, j = u.astype(np.int32), v.astype(np.int32)
        facet = 2 * (i * (n - 1) + j) + (u - i < v - j)
        contour = np.abs(z / CONTOUR_STEP_M - np.rint(z / CONTOUR_STEP_M)) * CONTOUR_STEP_M
        gap = contour / self._gradient.take(facet)
        shade = np.clip((z - LOWEST_M) * (255 / (HIGHEST_M - LOWEST_M)), 0, 255).astype(np.int32)
        albedo = self._tints.take(shade, axis=0) * (1 - 0.30 * _line(gap, pixel))[:, None]
        sunlit, sky = look_up((self._sunlit, self._open_sky), u * (cell / FINE_M), v * (cell / FINE_M))
        return self._lambert.take(facet) * sunlit, self._skyward.take(facet) * sky, albedo


def tint(height_m: Array) -> Array:
    """Albedo of ground at such heights [..., 3], in linear light."""
    share = np.clip((height_m - LOWEST_M) / (HIGHEST_M - LOWEST_M), 0, 1) * (len(TINTS) - 1)
    return np.stack([np.interp(share, np.arange(len(TINTS)), colour) for colour in TINTS.T], axis=-1)


def _creases(terrain: Terrain | None) -> Array:
    """Lines between which the ground is plane [k, 3], as `cast_ground` wants them: sides and diagonals of the cells."""
    if terrain is None:
        return np.zeros((0, 3))
    n, cell = len(terrain.heights), terrain.cell_m
    side, diagonal = (np.arange(n) - (n - 1) / 2) * cell, np.arange(1 - n, n) * cell
    groups = ((1, 0, side), (0, 1, side), (1, -1, diagonal))
    return np.concatenate([np.column_stack([np.tile([nx, ny], (len(c), 1)), c]) for nx, ny, c in groups])


def _line(gap: Floats, pixel: Floats) -> Floats:
    """Cover of a thin line at distance `gap`, which fades where it is thinner than a pixel."""
    half = np.maximum(LINE_HALF_WIDTH_M, 0.5 * pixel)
    return np.clip(0.5 + (half - gap) / pixel, 0, 1) * np.minimum(1, 3 * LINE_HALF_WIDTH_M / half)
