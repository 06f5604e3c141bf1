"""From recorded columns to the arrays of the C-step: the linear map L to the reduced state (paper Sec. III-C, IV-C).

Rows of all episodes of an iteration lie one under another, episodes in ascending order of their ids, so that
nothing depends on the order of arrival. Only canonical columns enter, and `face` merely says where the
triangle changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner.settings import ReducedState
from t6gps.storage import schema
from t6gps.storage.errors import DataError

NONE = -1
"""Stands for an edge that is null in the table."""

VELOCITY_N = 3
"""The cost state: the first entries of every reduced state are the centre of mass velocity."""

LOWER_NODES_N = 6


@dataclass(frozen=True)
class Rows:
    """Rows of all episodes, n in all.

    state         reduced state [n, nx], centre of mass velocity first (m/s, m)
    action        commanded rest lengths [n, nu], NaN on the last row of an episode (m)
    action_mean   the same without exploration noise (m)
    target        horizontal unit vector to the waypoint [n, 2]
    observation   what the policy saw [n, ny]
    kind, entry, exit   of the support triangle [n], NONE for a null edge
    starts        the row is the first one on its support triangle [n]
    acts          the row has an action [n]
    continues     the transition to the next row is a sample of the dynamics [n]: not after the last row of an
                  episode, nor over a jump between triangles without a common edge
    labels        canonical label of each entry of an action [n, nu] where actions are not canonical, else None
    """

    state: NDArray[np.float32]
    action: NDArray[np.float32]
    action_mean: NDArray[np.float32]
    target: NDArray[np.float32]
    observation: NDArray[np.float32]
    kind: NDArray[np.int64]
    entry: NDArray[np.int64]
    exit: NDArray[np.int64]
    starts: NDArray[np.bool_]
    acts: NDArray[np.bool_]
    continues: NDArray[np.bool_]
    labels: NDArray[np.int64] | None = None

    @property
    def samples(self) -> NDArray[np.float32]:
        """Joint vectors [x; u; x'] of every row and the one below it [n, 2 nx + nu]; sound where `continues`."""
        return np.hstack([self.state, self.action, np.roll(self.state, -1, axis=0)])


def read_rows(episodes: Mapping[int, pa.Table], reduced_state: ReducedState) -> Rows:
    """Rows of the `frames` tables in `episodes`, keyed by episode id.

    Raises DataError when there is no episode, when an episode has anything but one row without an action (its
    last), when no episode has a control step, or when a triangle is left that stays the same.
    """
    tables, acts, first = acting_rows(episodes)
    table = pa.concat_tables([table.select(_columns(reduced_state)) for table in tables])
    face, exit_ = schema.array(table, "face").astype(np.int64), _edges(table, "exit_edge")
    changes = face[1:] != face[:-1]
    if (exit_[:-1][~changes & acts[:-1]] != NONE).any():
        raise DataError("a row has an exit_edge although `face` stays the same; the worker's record is inconsistent")
    starts = first.copy()
    starts[1:] |= changes
    continues = acts.copy()
    continues[:-1] &= ~changes | (exit_[:-1] != NONE)
    kind = schema.array(table, "kind").astype(np.int64)
    return Rows(
        state=_reduce(table, reduced_state, kind),
        action=_actions(table, "action", acts),
        action_mean=_actions(table, "action_mean", acts),
        target=_vectors(table, "target_direction"),
        observation=_vectors(table, "observation"),
        kind=kind,
        entry=_edges(table, "entry_edge"),
        exit=exit_,
        starts=starts,
        acts=acts,
        continues=continues,
    )


def acting_rows(
    episodes: Mapping[int, pa.Table],
) -> tuple[list[pa.Table], NDArray[np.bool_], NDArray[np.bool_]]:
    """Tables of the episodes in ascending order of their ids, and which rows act and which are first [n].

    DataError as for `read_rows`.
    """
    if not episodes:
        raise DataError("the learner has no episodes; add at least one before it cuts segments")
    tables = [episodes[key] for key in sorted(episodes)]
    for key, table in episodes.items():
        nulls = table.column("action").null_count
        if nulls != 1 or table.column("action")[-1].is_valid:
            raise DataError(f"episode {key}: only the last row may lack an action, found {nulls} null actions")
    ends = np.cumsum([table.num_rows for table in tables])
    acts = np.ones(ends[-1], dtype=bool)
    acts[ends - 1] = False
    if not acts.any():
        raise DataError(f"none of the {len(tables)} episodes has a single control step; there is nothing to learn from")
    first = np.concatenate([[True], ~acts[:-1]])
    return tables, acts, first


_PARTS: dict[ReducedState, Sequence[str]] = {
    "com": (),
    "lower-nodes": ("nodes",),
    "nodes": ("nodes",),
    "nodes+vels": ("nodes", "node_velocities"),
    "nodes+cables": ("nodes", "rest_lengths"),
}


def _columns(reduced_state: ReducedState) -> list[str]:
    others = ["face", "kind", "entry_edge", "exit_edge", "target_direction", "observation", "action", "action_mean"]
    return ["com_velocity", *_PARTS[reduced_state], *others]


def _reduce(table: pa.Table, reduced_state: ReducedState, kind: NDArray[np.int64]) -> NDArray[np.float32]:
    parts = [_vectors(table, name) for name in ("com_velocity", *_PARTS[reduced_state])]
    if reduced_state == "lower-nodes":
        parts[1] = _lower_nodes(parts[1], kind)
    return np.hstack(parts)


def _lower_nodes(nodes: NDArray[np.float32], kind: NDArray[np.int64]) -> NDArray[np.float32]:
    """The six labels that lie lowest on average over a kind: one fixed selection per kind keeps the map linear."""
    nodes = nodes.reshape(len(nodes), -1, 3)
    lower = np.empty((len(nodes), LOWER_NODES_N * 3), dtype=np.float32)
    for value in np.unique(kind):
        rows = np.flatnonzero(kind == value)
        heights = nodes[rows, :, 2].mean(axis=0, dtype=np.float64)
        labels = np.sort(np.argsort(heights, kind="stable")[:LOWER_NODES_N])
        lower[rows] = nodes[rows][:, labels].reshape(len(rows), -1)
    return lower


def _vectors(table: pa.Table, name: str) -> NDArray[np.float32]:
    return np.asarray(schema.array(table, name), dtype=np.float32)


def _actions(table: pa.Table, name: str, acts: NDArray[np.bool_]) -> NDArray[np.float32]:
    values = _vectors(table, name)
    actions = np.full((len(acts), values.shape[1]), np.nan, dtype=np.float32)
    actions[acts] = values
    return actions


def _edges(table: pa.Table, name: str) -> NDArray[np.int64]:
    return np.nan_to_num(schema.array(table, name).astype(np.float64), nan=NONE).astype(np.int64)
