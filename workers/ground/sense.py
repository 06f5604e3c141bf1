"""Whether what a file holds makes sense as ground for a robot with bars of 1.94 m.

What is impossible is refused. What is doubtful is refused too, unless `terrain.accept` names the doubt.
"""

from __future__ import annotations

import numpy as np

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.state import Array
from t6gps.workers.robot.topology import BAR_LENGTH_M
from t6gps.workers.settings import Doubt

FINEST_CELL_M = 0.1
"""As wide as a bar."""

COARSEST_CELL_M = 2.0
"""As long as a bar."""

STEEPEST_MEAN_SLOPE_DEG = 60.0
"""Ground that is steeper on average cannot be stood on."""

HIGHEST_M = 500.0
"""Above or below z = 0. The simulation parks bars from 1,000 m on, out of reach of any ground."""

WIDEST_SHARE = 2.0
"""A surface that is more often as wide as the ground loses three quarters of itself."""


def check_grid(shape: tuple[int, ...], size_m: float) -> None:
    """TerrainError unless a map of this shape is a square grid of sensible cells over `size_m`."""
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] < 3:
        raise TerrainError(f"a height map must be square, at least 3 x 3, found {list(shape)}; crop it")
    cell_m = size_m / (shape[0] - 1)
    if not FINEST_CELL_M <= cell_m <= COARSEST_CELL_M:
        raise TerrainError(
            f"{shape[0]} x {shape[0]} heights over {size_m:g} m are {cell_m:.3g} m apart; "
            f"allowed: {FINEST_CELL_M} to {COARSEST_CELL_M} m; change terrain.size_m or resample the map"
        )


def check_extent(corners: Array, size_m: float, accept: tuple[Doubt, ...]) -> None:
    """TerrainError where a surface [m, 3, 3] (m) is smaller than the ground, or doubtfully large."""
    width, depth, height = np.ptp(corners, axis=(0, 1))
    if min(width, depth) < size_m - 1e-6:
        remedy = (
            "its second-largest extent is along z, so export it with z up"
            if height > min(width, depth) and np.median([width, depth, height]) >= size_m - 1e-6
            else "set terrain.size_m, or scale the surface to metres"
        )
        raise TerrainError(
            f"the surface is {width:.4g} x {depth:.4g} m and {height:.4g} m high, smaller than the ground of "
            f"{size_m:g} m; {remedy}"
        )
    if max(width, depth) > WIDEST_SHARE * size_m:
        _doubt(
            "extent",
            f"the surface is {width:.6g} x {depth:.6g} m, so that the ground of {size_m:g} m would be a small piece "
            "from its middle; scale it to metres, cut out the piece that is meant",
            accept,
        )


def check_heights(terrain: Terrain, accept: tuple[Doubt, ...]) -> None:
    """TerrainError for heights (m) that are not finite, too far from zero, too steep to stand on, or doubtful."""
    heights = terrain.heights
    broken = np.argwhere(~np.isfinite(heights))
    if len(broken):
        raise TerrainError(f"{len(broken)} heights are not finite, the first at {broken[0].tolist()}; fill them")
    low, high = float(heights.min()), float(heights.max())
    if max(-low, high) > HIGHEST_M:
        raise TerrainError(
            f"heights lie from {low:.6g} to {high:.6g} m; allowed: {-HIGHEST_M:g} to {HIGHEST_M:g} m; "
            "save them in metres, and subtract their mean"
        )
    slope_deg, _, range_m = terrain.statistics()
    if slope_deg > STEEPEST_MEAN_SLOPE_DEG:
        raise TerrainError(
            f"the ground slopes by {slope_deg:.0f} deg on average and cannot be stood on; allowed: up to "
            f"{STEEPEST_MEAN_SLOPE_DEG:.0f} deg; lower its heights (in metres) or enlarge terrain.size_m"
        )
    size_m = 2 * terrain.half_size_m
    if range_m > size_m:
        what = f"heights range over {range_m:.4g} m on a ground {size_m:g} m wide; save them in metres"
        _doubt("range", what, accept)
    steps = [np.abs(np.diff(heights, axis=axis)) for axis in (0, 1)]
    if max(step.max() for step in steps) > BAR_LENGTH_M:
        axis = int(steps[1].max() > steps[0].max())
        i, j = np.unravel_index(steps[axis].argmax(), steps[axis].shape)
        _doubt(
            "step",
            f"from the height at [{i}, {j}] to its neighbour along {'xy'[axis]} it is {steps[axis][i, j]:.4g} m, more "
            f"than a bar of {BAR_LENGTH_M} m; smooth the ground there",
            accept,
        )
    if range_m == 0:
        _doubt("flat", "all heights are equal, which needs no file; save the map that is meant", accept)


def _doubt(doubt: Doubt, what: str, accept: tuple[Doubt, ...]) -> None:
    if doubt not in accept:
        names = ", ".join(f'"{name}"' for name in (*accept, doubt))
        raise TerrainError(f"{what}, or set terrain.accept = [{names}] if it is meant so")
