"""Standard guided policy search (paper Algorithm 1): samples are localised by start, direction and time step alone.

Every episode starts from the same rest state and heads for one of J directions. All episodes of a direction form one
class, and step t of the class holds their t-th rows: no segments, no warping, no symmetry. States and actions are
therefore in world axes and labels; models, backward pass and S-step are those of T6-GPS, so that the two methods
differ in their localisation and in nothing else. The policy still sees canonical observations.

    x = [v, centres of the bars about the centre of mass, axes of the bars]     nx = 39, as many as `nodes` has
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import acting, rows_of, spread
from t6gps.learner.rows import NONE, Columns, Floats, Ints, Rows
from t6gps.storage import schema

Array = NDArray[np.float64]
Entry = TypeVar("Entry", bound=np.floating)


@dataclass(frozen=True)
class InWorld:
    """Reads rows in world axes; the direction of an episode stands in the place of the entry edge.

    labels   canonical label of each world label, by symmetry element [elements, nu]
    """

    labels: Ints

    def read(self, frames: pa.Table) -> Columns:
        """Columns of one episode; `direction` is that of its first row. DataError as from `features.Canonical.read`."""
        acts = acting(frames)
        rows_n = len(acts)
        canonical = self.labels[_numbers(frames, "element").astype(np.int64)]
        position, waypoint = (
            np.stack([_numbers(frames, f"{name}_{axis}_m") for axis in "xy"], axis=1) for name in ("com", "waypoint")
        )
        target = (waypoint - position) / np.linalg.norm(waypoint - position, axis=1, keepdims=True)
        return {
            "state": _world_state(frames).astype(np.float32),
            "action": spread(to_world(_numbers(frames, "action"), canonical[acts]), acts),
            "action_mean": spread(to_world(_numbers(frames, "action_mean"), canonical[acts]), acts),
            "target": target.astype(np.float32),
            "observation": _numbers(frames, "observation").astype(np.float32),
            "kind": np.zeros(rows_n, dtype=np.int64),
            "exit": np.full(rows_n, NONE),
            "starts": np.arange(rows_n) == 0,
            "acts": acts,
            "continues": acts,
            "labels": canonical,
            "direction": np.tile(target[0].round(3), (rows_n, 1)),
        }

    def rows(self, columns: Columns) -> Rows:
        """Rows of all episodes, whose directions are numbered."""
        _, direction = np.unique(columns["direction"], axis=0, return_inverse=True)
        return rows_of(columns, entry=direction.ravel().astype(np.int64))


def _numbers(table: pa.Table, name: str) -> Array:
    return np.asarray(schema.array(table, name), dtype=np.float64)


def _world_state(table: pa.Table) -> Array:
    centres = _numbers(table, "bar_positions").reshape(-1, 6, 3)
    x, y, z, w = np.moveaxis(_numbers(table, "bar_orientations").reshape(-1, 6, 4), -1, 0)
    axes = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    about = centres - centres.mean(axis=1, keepdims=True)
    velocity = _numbers(table, "bar_velocities").reshape(-1, 6, 3).mean(axis=1)
    return np.concatenate([velocity, about.reshape(-1, 18), axes.reshape(-1, 18)], axis=1)


def to_world(actions: NDArray[Entry], canonical: Ints) -> NDArray[Entry]:
    """Canonical actions [n, nu] in world labels."""
    return np.take_along_axis(actions, canonical, axis=1)


def to_canonical(actions: Floats, canonical: Ints) -> Floats:
    """Actions [n, nu] in world labels, relabelled."""
    relabelled = np.empty_like(actions)
    np.put_along_axis(relabelled, canonical, actions, axis=1)
    return relabelled
