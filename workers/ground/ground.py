"""The ground of an episode: generated from a seed or read from a file, tilted, and fenced."""

from __future__ import annotations

import numpy as np

from t6gps.storage.objects import place
from t6gps.workers.ground.surface import load
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.settings import TerrainSettings

FENCE_HEIGHT_M = 2.0
"""The outermost ring of heights is raised by this much: a wall of 76 deg that no bar climbs."""


def ground(settings: TerrainSettings, seed: int, difficulty: float) -> Terrain | None:
    """Ground of an episode, None for the endless plane. Raises TerrainError as `generate` and `surface.load`."""
    if settings.file is not None:
        terrain = load(place.at(settings.file), settings.size_m, settings.png_range_m, settings.accept)
    elif difficulty > 0 or settings.tilt_deg > 0:
        terrain = generate(seed, difficulty, settings.size_m)
    else:
        return None
    return fenced(tilted(terrain, settings.tilt_deg))


def tilted(terrain: Terrain, tilt_deg: float) -> Terrain:
    """The ground rising towards +x by `tilt_deg`, its middle where it was."""
    x = (np.arange(len(terrain.heights)) - (len(terrain.heights) - 1) / 2) * terrain.cell_m
    return Terrain(terrain.heights + np.tan(np.radians(tilt_deg)) * x[:, None], terrain.cell_m)


def fenced(terrain: Terrain) -> Terrain:
    """The ground with a wall along its sides that the robot cannot leave."""
    heights = terrain.heights.copy()
    for side in (0, -1):
        heights[side, :] += FENCE_HEIGHT_M
        heights[1:-1, side] += FENCE_HEIGHT_M
    return Terrain(heights, terrain.cell_m)
