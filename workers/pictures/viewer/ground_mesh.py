"""The ground around a path as a mesh of its own facets, for viewers that draw triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures.landscape import FLAT_TINT, GRID_STEP_M, tint

Array = NDArray[np.float64]

REACH_M = 6.0
"""How far from the path ground is shown: about the farthest that one sees of it in a picture."""


@dataclass(frozen=True)
class GroundMesh:
    """m triangles with corners of their own, so that each is plane in the light, too.

    corners   anticlockwise from above [m, 3, 3] (m)
    normals   unit vectors [m, 3]
    light     albedo of the corners, in linear light [m, 3, 3]
    """

    corners: Array
    normals: Array
    light: Array


def around(terrain: Terrain | None, path: Array) -> GroundMesh:
    """The facets of a ground (None: flat) near a horizontal path [n, 2] (m)."""
    ground = terrain or _plane(path)
    vertices, faces = ground.triangles()
    reach_m = REACH_M + ground.cell_m  # cells are whole, so that the sides are straight
    low, high = path.min(axis=0) - reach_m, path.max(axis=0) + reach_m
    near = ((vertices[:, :2] >= low) & (vertices[:, :2] <= high)).all(axis=1)
    corners = vertices[faces[near[faces].all(axis=1)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = np.broadcast_to(FLAT_TINT.astype(float), corners.shape) if terrain is None else tint(corners[..., 2])
    return GroundMesh(corners, normals / np.linalg.norm(normals, axis=1, keepdims=True), light)


def _plane(path: Array) -> Terrain:
    """Level ground that reaches beyond a path."""
    cells_n = 2 * int(np.ceil((np.abs(path).max() + REACH_M) / GRID_STEP_M + 1))
    return Terrain(np.zeros((cells_n + 1, cells_n + 1)), GRID_STEP_M)
