"""Standard guided policy search (paper Algorithm 1): samples are localised by start, direction and time step alone.

Every episode starts from the same rest state and heads for one of J directions. All episodes of a direction form one
class, and step t of the class holds their t-th rows: no segments, no warping, no symmetry. States and actions are
therefore in world axes and labels; models, backward pass and S-step are those of T6-GPS, so that the two methods
differ in their localisation and in nothing else. The policy still sees canonical observations.

    x = [v, centres of the bars about the centre of mass, axes of the bars]     nx = 39, as many as `nodes` has
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import NONE, Rows, acting_rows
from t6gps.storage import schema

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


def read_rows(episodes: Mapping[int, pa.Table], labels: Labels) -> Rows:
    """Rows in world axes; the direction of an episode stands in the place of the entry edge.

    `labels` [elements, nu] gives the canonical label of each world label, by symmetry element. DataError as for
    `features.read_rows`.
    """
    tables, acts, starts = acting_rows(episodes)
    table = pa.concat_tables(tables)
    rows_n = len(acts)
    canonical = labels[_numbers(table, "element").astype(np.int64)]
    ways = np.stack([_numbers(table, f"waypoint_{axis}_m") - _numbers(table, f"com_{axis}_m") for axis in "xy"], axis=1)
    target = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    first = target[np.maximum.accumulate(np.where(starts, np.arange(rows_n), 0))]
    _, direction = np.unique(first.round(3), axis=0, return_inverse=True)
    nothing = np.full(rows_n, NONE)
    return Rows(
        state=_world_state(table).astype(np.float32),
        action=_in_world(table, "action", acts, canonical),
        action_mean=_in_world(table, "action_mean", acts, canonical),
        target=target.astype(np.float32),
        observation=_numbers(table, "observation").astype(np.float32),
        kind=np.zeros(rows_n, dtype=np.int64),
        entry=direction.ravel().astype(np.int64),
        exit=nothing,
        starts=starts,
        acts=acts,
        continues=acts.copy(),
        labels=canonical,
    )


def _numbers(table: pa.Table, name: str) -> Array:
    return np.asarray(schema.array(table, name), dtype=np.float64)


def _world_state(table: pa.Table) -> Array:
    centres = _numbers(table, "bar_positions").reshape(-1, 6, 3)
    x, y, z, w = np.moveaxis(_numbers(table, "bar_orientations").reshape(-1, 6, 4), -1, 0)
    axes = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    about = centres - centres.mean(axis=1, keepdims=True)
    velocity = _numbers(table, "bar_velocities").reshape(-1, 6, 3).mean(axis=1)
    return np.concatenate([velocity, about.reshape(-1, 18), axes.reshape(-1, 18)], axis=1)


def _in_world(table: pa.Table, name: str, acts: NDArray[np.bool_], canonical: Labels) -> NDArray[np.float32]:
    values = _numbers(table, name)
    actions = np.full((len(acts), values.shape[1]), np.nan, dtype=np.float32)
    actions[acts] = to_world(values, canonical[acts])
    return actions


def to_world(actions: NDArray[Any], canonical: Labels) -> NDArray[Any]:
    """Canonical actions [n, nu] in world labels."""
    return np.take_along_axis(actions, canonical, axis=1)


def to_canonical(actions: NDArray[np.float32], canonical: Labels) -> NDArray[np.float32]:
    """Actions [n, nu] in world labels, relabelled."""
    relabelled = np.empty_like(actions)
    np.put_along_axis(relabelled, canonical, actions, axis=1)
    return relabelled
