"""From recorded columns to rows: the linear map L to the reduced state (paper Sec. III-C, IV-C; Algorithm 2, line 6).

Only canonical columns enter, and `face` merely says where the triangle changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner.rows import NONE, VELOCITY_N, AnyArray, Columns, Flags, Floats, Ints, Rows
from t6gps.learner.settings import ReducedState
from t6gps.storage import schema
from t6gps.storage.errors import DataError
from t6gps.storage.fields import vector_length

LOWER_NODES_N = 6

_PARTS: dict[ReducedState, Sequence[str]] = {
    "com": (),
    "lower-nodes": ("nodes",),
    "nodes": ("nodes",),
    "nodes+vels": ("nodes", "node_velocities"),
    "nodes+cables": ("nodes", "rest_lengths"),
}

COLUMNS = (
    *("face", "kind", "entry_edge", "exit_edge", "com_velocity", "nodes", "node_velocities", "rest_lengths"),
    *("action", "action_mean", "target_direction", "observation"),
)
"""Columns of `frames` that are read, by one reduced state or another."""


def whole_columns(reduced_state: ReducedState) -> dict[str, slice]:
    """Columns of `frames` that a reduced state has whole, and their place in it; lower nodes are half of a column."""
    names = ("com_velocity", *(() if reduced_state == "lower-nodes" else _PARTS[reduced_state]))
    ends = np.cumsum([vector_length(schema.FRAMES.field(name)) or 0 for name in names]).tolist()
    return {name: slice(first, end) for name, first, end in zip(names, [0, *ends], ends, strict=False)}


@dataclass(frozen=True)
class Canonical:
    """Reads rows in the frames and labels that symmetry reduction gives them."""

    reduced_state: ReducedState

    def read(self, frames: pa.Table) -> Columns:
        """Columns of one episode, with all nodes where the reduced state has some of them.

        Raises DataError when the episode has anything but one row without an action (its last), or when a triangle is
        left that stays the same.
        """
        acts = acting(frames)
        face, exit_ = schema.array(frames, "face").astype(np.int64), _edges(frames, "exit_edge")
        changes = face[1:] != face[:-1]
        if (exit_[:-1][~changes] != NONE).any():
            raise DataError(
                "a row has an exit_edge although `face` stays the same; the worker's record is inconsistent"
            )
        continues = acts.copy()
        continues[:-1] &= ~changes | (exit_[:-1] != NONE)
        return {
            "state": np.hstack([vectors(frames, name) for name in ("com_velocity", *_PARTS[self.reduced_state])]),
            "action": spread(vectors(frames, "action"), acts),
            "action_mean": spread(vectors(frames, "action_mean"), acts),
            "target": vectors(frames, "target_direction"),
            "observation": vectors(frames, "observation"),
            "kind": schema.array(frames, "kind").astype(np.int64),
            "entry": _edges(frames, "entry_edge"),
            "exit": exit_,
            "starts": np.concatenate([[True], changes]),
            "acts": acts,
            "continues": continues,
        }

    def rows(self, columns: Columns) -> Rows:
        """Rows of all episodes; which nodes are the lower ones depends on all of them."""
        if self.reduced_state == "lower-nodes":
            columns = columns | {"state": _lower_nodes(columns["state"], columns["kind"])}
        return rows_of(columns)


def rows_of(columns: Columns, **others: AnyArray) -> Rows:
    """Rows of the columns that are named after their parts, and of others."""
    named: dict[str, Any] = {part.name: columns[part.name] for part in fields(Rows) if part.name in columns}
    return Rows(**named | others)


def _lower_nodes(state: Floats, kind: Ints) -> Floats:
    """The six labels that lie lowest on average over a kind: one fixed selection per kind keeps the map linear."""
    nodes = state[:, VELOCITY_N:].reshape(len(state), -1, 3)
    lower = np.empty((len(state), VELOCITY_N + LOWER_NODES_N * 3), dtype=np.float32)
    lower[:, :VELOCITY_N] = state[:, :VELOCITY_N]
    for value in np.unique(kind):
        chosen = np.flatnonzero(kind == value)
        heights = nodes[chosen, :, 2].mean(axis=0, dtype=np.float64)
        labels = np.sort(np.argsort(heights, kind="stable")[:LOWER_NODES_N])
        lower[chosen, VELOCITY_N:] = nodes[chosen][:, labels].reshape(len(chosen), -1)
    return lower


def acting(frames: pa.Table) -> Flags:
    """Which rows of an episode have an action [rows]: all but the last. DataError otherwise."""
    nulls = frames.column("action").null_count
    if nulls != 1 or frames.column("action")[-1].is_valid:
        raise DataError(f"only the last row may lack an action, found {nulls} null actions")
    acts = np.ones(frames.num_rows, dtype=bool)
    acts[-1] = False
    return acts


def vectors(frames: pa.Table, name: str) -> Floats:
    """Entries of a vector column that are not null [rows, length]."""
    return np.asarray(schema.array(frames, name), dtype=np.float32)


def spread(actions: NDArray[np.floating], acts: Flags) -> Floats:
    """Actions of the rows that act, and NaN in the others [rows, nu]."""
    whole = np.full((len(acts), actions.shape[1]), np.nan, dtype=np.float32)
    whole[acts] = actions
    return whole


def _edges(frames: pa.Table, name: str) -> Ints:
    return np.nan_to_num(schema.array(frames, name).astype(np.float64), nan=NONE).astype(np.int64)
