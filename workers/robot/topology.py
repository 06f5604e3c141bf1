"""The 6-bar, 24-cable icosahedral tensegrity: nodes, bars, cables, faces and their adjacency, derived from geometry.

Nodes are the cyclic permutations of (+-L/4, +-L/2, 0) (paper Sec. II-B, Fig. 2). Bar b joins the nodes 2b and 2b + 1.
Pairs of nodes at distance sqrt(3/8) L are cables, pairs at L/2 (beside bars) are virtual edges. Every face is a
triangle of three such edges: a closed one (Delta) has three cables, an open one (Lambda) two cables and the
virtual edge. Faces list their nodes counter-clockwise seen from outside; edge e of a face joins its nodes e and
(e + 1) mod 3, and edge 0 of a Lambda is the virtual edge.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

BAR_LENGTH_M = 1.94
"""As in the paper."""

BARS_N = 6
NODES_N = 12
CABLES_N = 24
FACES_N = 20

DELTA = 0
"""Kind of a closed face."""

LAMBDA = 1
"""Kind of an open face."""

KIND_NAMES = ("Delta", "Lambda")


def _neutral_nodes() -> NDArray[np.float64]:
    quarter, half = BAR_LENGTH_M / 4, BAR_LENGTH_M / 2
    corners = [(side * quarter, end * half, 0.0) for side in (1, -1) for end in (1, -1)]
    return np.array([np.roll(corner, axis) for axis in range(3) for corner in corners])


def _pairs_at(nodes: NDArray[np.float64], distance_m: float) -> list[tuple[int, int]]:
    gaps = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    return [(i, j) for i, j in combinations(range(NODES_N), 2) if abs(gaps[i, j] - distance_m) < 1e-9 * BAR_LENGTH_M]


def _faces(nodes: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cables = set(_pairs_at(nodes, CABLE_LENGTH_M))
    virtual = set(_pairs_at(nodes, BAR_LENGTH_M / 2))
    faces: dict[int, list[tuple[int, int, int]]] = {DELTA: [], LAMBDA: []}
    for triple in combinations(range(NODES_N), 3):
        edges = list(combinations(triple, 2))
        if not all(edge in cables or edge in virtual for edge in edges):
            continue
        a, b, c = triple
        if np.dot(np.cross(nodes[b] - nodes[a], nodes[c] - nodes[a]), nodes[a] + nodes[b] + nodes[c]) < 0:
            b, c = c, b
        open_edges = [i for i, pair in enumerate([(a, b), (b, c), (c, a)]) if tuple(sorted(pair)) in virtual]
        first = open_edges[0] if open_edges else 0
        ordered = (a, b, c, a, b, c)[first : first + 3]
        faces[LAMBDA if open_edges else DELTA].append((ordered[0], ordered[1], ordered[2]))
    kinds = [DELTA] * len(faces[DELTA]) + [LAMBDA] * len(faces[LAMBDA])
    return np.array(faces[DELTA] + faces[LAMBDA]), np.array(kinds)


def _adjacency(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    owners: dict[frozenset[int], list[tuple[int, int]]] = {}
    for face, corners in enumerate(faces):
        for edge in range(3):
            owners.setdefault(frozenset((int(corners[edge]), int(corners[(edge + 1) % 3]))), []).append((face, edge))
    neighbor_face = np.empty((FACES_N, 3), dtype=np.int64)
    neighbor_edge = np.empty((FACES_N, 3), dtype=np.int64)
    for (face_a, edge_a), (face_b, edge_b) in owners.values():
        neighbor_face[face_a, edge_a], neighbor_edge[face_a, edge_a] = face_b, edge_b
        neighbor_face[face_b, edge_b], neighbor_edge[face_b, edge_b] = face_a, edge_a
    return neighbor_face, neighbor_edge


def _read_only(array: NDArray) -> NDArray:  # type: ignore[type-arg]
    array.setflags(write=False)
    return array


CABLE_LENGTH_M = float(np.sqrt(3 / 8) * BAR_LENGTH_M)
"""Length of every cable in the neutral shape (m)."""

NODES_M = _read_only(_neutral_nodes())
"""Neutral node positions about the centre [12, 3] (m)."""

BARS = _read_only(np.arange(NODES_N).reshape(BARS_N, 2))
"""Node pair of each bar [6, 2]."""

CABLES = _read_only(np.array(_pairs_at(NODES_M, CABLE_LENGTH_M)))
"""Node pair of each cable, lower node first [24, 2]."""

FACES, FACE_KINDS = map(_read_only, _faces(NODES_M))
"""Nodes of each face, counter-clockwise from outside [20, 3], the 8 Delta first; kind of each face [20]."""

NEIGHBOR_FACE, NEIGHBOR_EDGE = map(_read_only, _adjacency(FACES))
"""Across edge e of face f lies face NEIGHBOR_FACE[f, e], whose edge NEIGHBOR_EDGE[f, e] is the same [20, 3]."""
