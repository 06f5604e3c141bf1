"""Stays of the robot on its support triangles, and whether it moves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.workers.episode.recording import STUCK_STEPS, stuck_by_distance
from t6gps.workers.robot.symmetry import EDGE_NAMES
from t6gps.workers.robot.topology import FACE_KINDS, KIND_NAMES


class Stay(NamedTuple):
    """Rows start .. stop - 1 on one triangle, and the name of its class: kind, entry and exit edge."""

    start: int
    stop: int
    kind: int
    name: str


def stays(frames: pa.Table) -> Iterator[Stay]:
    """The stays of an episode, in order."""
    face = np.asarray(schema.array(frames, "face"), dtype=np.int64)
    entry, exit_ = (frames[f"{way}_edge"].to_pylist() for way in ("entry", "exit"))
    for start, stop in pairwise(np.r_[0, np.flatnonzero(np.diff(face)) + 1, len(face)].tolist()):
        kind = int(FACE_KINDS[face[start]])
        edges = ("..." if edge is None else EDGE_NAMES[kind][edge] for edge in (entry[start], exit_[stop - 1]))
        yield Stay(start, stop, kind, f"{KIND_NAMES[kind]}: {' → '.join(edges)}")


def stuck(com: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the robot is stuck by distance, for rows of the centre of mass [T + 1, 3] (m)."""
    return np.r_[np.zeros(STUCK_STEPS, bool), stuck_by_distance(com)][: len(com)]
