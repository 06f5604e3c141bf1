"""The 24 maps H_i of the neutral shape and the frames they give (paper Sec. II-B).

An element g of the symmetry group T_h is an orthogonal matrix R_g that carries the neutral nodes, bars and cables
onto themselves. It relabels node j as NODE_MAP[g, j], and so on. Relabelling alone would need gravity to turn along,
so H_g pairs it with a gravity-preserving map of the world: a turn about the vertical, after the mirror y -> -y when
g is improper. The dynamics on flat ground commute with every such pair.

    g       element, 0 .. 23; the proper ones (rotations) come first, 0 is the identity
    W       world map of a frame [3, 3]: turn(yaw) or turn(yaw) mirror
    f, e    face and edge of the face, numbered as in `topology`

The canonical frame of a support triangle relabels it as the reference face of its kind, its entry edge as the
reference edge (edge 0 of a Delta; for a Lambda the virtual edge stays edge 0 and a cable entry becomes edge 1), and
turns the world so that the triangle has the reference orientation, edge 0 behind (towards -x).
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.robot.topology import BARS, CABLES, DELTA, FACE_KINDS, FACES, FACES_N, LAMBDA, NODES_M, NODES_N

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


def _elements() -> tuple[Array, Labels]:
    """Every orthogonal matrix that permutes the nodes and keeps the cables: images of one Delta decide it."""
    cables = {frozenset(map(int, pair)) for pair in CABLES}
    base = np.linalg.inv(NODES_M[FACES[0]].T)
    elements: list[tuple[bool, Array, Labels]] = []
    for face in FACES[FACE_KINDS == DELTA]:
        for corners in permutations(face):
            matrix = NODES_M[list(corners)].T @ base
            gaps = np.linalg.norm((NODES_M @ matrix.T)[:, None] - NODES_M[None], axis=2)
            images = gaps.argmin(axis=1)
            keeps_nodes = len(set(images)) == NODES_N and gaps.min(axis=1).max() < 1e-9
            if keeps_nodes and all(frozenset((int(images[a]), int(images[b]))) in cables for a, b in CABLES):
                elements.append((bool(np.linalg.det(matrix) < 0), np.round(matrix), images))
    elements.sort(key=lambda item: (item[0], tuple(item[2])))
    return np.array([matrix for _, matrix, _ in elements]), np.array([images for _, _, images in elements])


def _pair_map(pairs: Labels) -> Labels:
    """Image of each pair of nodes under each element [24, len(pairs)]."""
    index = {frozenset(map(int, pair)): i for i, pair in enumerate(pairs)}
    return np.array([[index[frozenset(map(int, images[pair]))] for pair in pairs] for images in NODE_MAP])


def _face_maps() -> tuple[Labels, Labels]:
    """Image of each face [24, 20], and of each edge of each face as an edge of the image [24, 20, 3]."""
    index = {frozenset(map(int, face)): i for i, face in enumerate(FACES)}
    faces = np.array([[index[frozenset(map(int, images[face]))] for face in FACES] for images in NODE_MAP])
    edges = np.empty((len(NODE_MAP), FACES_N, 3), dtype=np.int64)
    for g, f, e in np.ndindex(*edges.shape):
        ends = {int(NODE_MAP[g, FACES[f, e]]), int(NODE_MAP[g, FACES[f, (e + 1) % 3]])}
        image = FACES[faces[g, f]]
        edges[g, f, e] = next(k for k in range(3) if {int(image[k]), int(image[(k + 1) % 3])} == ends)
    return faces, edges


MATRICES, NODE_MAP = _elements()
"""Orthogonal matrix R_g [24, 3, 3]; image of node j under g [24, 12]: R_g NODES_M[j] = NODES_M[NODE_MAP[g, j]]."""

ELEMENTS_N = len(MATRICES)
PROPER = np.linalg.det(MATRICES) > 0
"""Whether an element is a rotation [24]."""

BAR_MAP = _pair_map(BARS)
"""Images of bars [24, 6]."""

CABLE_MAP = _pair_map(CABLES)
"""Images of cables [24, 24]."""

FACE_MAP, EDGE_MAP = _face_maps()
"""Images of faces [24, 20] and of their edges [24, 20, 3]."""

NODES_FROM = np.argsort(NODE_MAP, axis=1)
"""Inverse map of nodes [24, 12]: canonical[k] = world[NODES_FROM[g, k]]."""

BARS_FROM = np.argsort(BAR_MAP, axis=1)
"""Inverse map of bars [24, 6]."""

CABLES_FROM = np.argsort(CABLE_MAP, axis=1)
"""Inverse map of cables [24, 24]."""

EDGE_NAMES = (("back", "left", "right"), ("virtual", "left", "right"))
"""Of the canonical edges of each kind of triangle."""

REFERENCE_FACE = np.array([int(np.flatnonzero(kind == FACE_KINDS)[0]) for kind in (DELTA, LAMBDA)])
"""Reference face of each kind [2]."""


def _element_by_edge() -> Labels:
    """Element that takes face f to its reference and edge e to the reference edge [20, 3]; -1 where there is none."""
    table = np.full((FACES_N, 3), -1)
    for f, kind in enumerate(FACE_KINDS):
        wanted = 0 if kind == DELTA else 1
        for g in np.flatnonzero(FACE_MAP[:, f] == REFERENCE_FACE[kind]):
            table[f, np.flatnonzero(EDGE_MAP[g, f] == wanted)[0]] = g
    return table


ELEMENT_BY_EDGE = _element_by_edge()
"""Element of the frame of face f whose reference edge is edge e [20, 3]; -1 for the virtual edge of a Lambda."""


def _reference_triangles() -> Array:
    """Horizontal corners of the neutral robot's support triangle in its canonical frame [2, 3, 2] (m)."""
    triangles = []
    for face in REFERENCE_FACE:
        corners = NODES_M[FACES[face]]
        down = corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0))
        behind = corners[:2].mean(axis=0) - corners.mean(axis=0)
        forward = -behind / np.linalg.norm(behind)
        left = np.cross(-down, forward)
        triangles.append((corners - corners.mean(axis=0)) @ np.stack([forward, left], axis=1))
    return np.array(triangles)


REFERENCE_TRIANGLES_M = _reference_triangles()
"""Horizontal corners of each kind's triangle in the reference orientation [2, 3, 2] (m)."""


def frame_yaw(nodes: Array, face: int, element: int) -> float:
    """Turn (rad) that gives the support triangle its reference orientation, least squares over its three nodes.

    nodes [12, 3] are world positions (m); for an improper element the mirror y -> -y comes before the turn.
    """
    reference = REFERENCE_FACE[FACE_KINDS[face]]
    corners = nodes[NODES_FROM[element, FACES[reference]], :2]
    x, y = (corners - corners.sum(axis=0) / 3).T
    if not PROPER[element]:
        y = -y
    goal_x, goal_y = REFERENCE_TRIANGLES_M[FACE_KINDS[face]].T
    return float(np.arctan2(x @ goal_y - y @ goal_x, x @ goal_x + y @ goal_y))


def world_map(element: NDArray[np.integer] | int, yaw_rad: Array | float) -> Array:
    """World map W of a frame [..., 3, 3]: canonical vector = W @ world vector."""
    element, yaw = np.broadcast_arrays(element, yaw_rad)
    cosine, sine, side = np.cos(yaw), np.sin(yaw), np.where(PROPER[element], 1.0, -1.0)
    zero = np.zeros_like(cosine)
    rows = [cosine, -sine * side, zero, sine, cosine * side, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(*element.shape, 3, 3)
