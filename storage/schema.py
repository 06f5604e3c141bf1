"""Arrow schemas of everything a run keeps, with units in the field metadata, and the check at every boundary.

Row t of `frames` holds state t, the action taken at t, and nothing of what followed; the last state of an episode
(row T) has null actions. Canonical columns are expressed in the symmetry-reduced frame of that row: labels permuted
by the row's `element`, the world mirrored when the element is improper, and turned about the vertical. The frame
stays the same while the support triangle stays the same. Columns without the word canonical are world quantities.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.errors import DataError

SCHEMA_VERSION = 5
"""Grows with every change. Versions 2, 3 and 5 added columns at the end of `iterations`, version 2 of `classes`; they
are nullable, since older runs have none. Version 4 added the nodes to `observation`. Version 5 has null where older
versions had 0 for what there is none of: standard errors of one episode, waypoints of a far direction, modes and
residual of a class without a sample."""
SENSORS_N, SHAPE_N = 47, 36
OBSERVATION_N = SENSORS_N + SHAPE_N
"""Entries of an observation: kind, 24 rest lengths, 18 angular velocities, target and track direction; 12 nodes."""
TARGET = slice(43, 45)
"""Of these the target direction."""


def _scalar(name: str, kind: pa.DataType, unit: str, text: str, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable, {"unit": unit, "description": text})


def _vector(name: str, length: int, unit: str, text: str, nullable: bool = False) -> pa.Field:
    metadata = {"unit": unit, "description": text, "length": str(length)}
    return pa.field(name, pa.list_(pa.float32()), nullable, metadata)


def _schema(*fields: pa.Field) -> pa.Schema:
    return pa.schema(fields, {"t6gps_schema_version": str(SCHEMA_VERSION)})


FRAMES = _schema(
    _scalar("episode_id", pa.int64(), "1", "episode, unique in the run"),
    _scalar("iteration", pa.int32(), "1", "iteration of the run that sampled the episode"),
    _scalar("step", pa.int32(), "1", "control step t = 0 .. T, one row each"),
    _scalar("time_s", pa.float64(), "s", "time since the start of the episode"),
    _scalar("policy_version", pa.int32(), "1", "version of the policy that acts"),
    _scalar("com_x_m", pa.float64(), "m", "centre of mass, x"),
    _scalar("com_y_m", pa.float64(), "m", "centre of mass, y"),
    _scalar("com_z_m", pa.float64(), "m", "centre of mass, height"),
    _scalar("speed_m_per_s", pa.float64(), "m/s", "norm of the centre of mass velocity"),
    _scalar("forward_speed_m_per_s", pa.float64(), "m/s", "centre of mass velocity towards the waypoint"),
    _scalar("cost", pa.float64(), "m2/s2", "running cost of state t (paper Sec. IV-A)"),
    _scalar("waypoint", pa.int32(), "1", "number of the active waypoint, counted from 0"),
    _scalar("waypoint_x_m", pa.float64(), "m", "active waypoint, x"),
    _scalar("waypoint_y_m", pa.float64(), "m", "active waypoint, y"),
    _scalar("waypoint_distance_m", pa.float64(), "m", "horizontal distance to the active waypoint"),
    _scalar("face", pa.int8(), "1", "support triangle under the centre of mass, 0 .. 19"),
    _scalar("kind", pa.int8(), "1", "kind of the support triangle: 0 Delta, 1 Lambda"),
    _scalar("entry_edge", pa.int8(), "1", "canonical edge through which the triangle was entered", nullable=True),
    _scalar(
        "exit_edge",
        pa.int8(),
        "1",
        "canonical edge through which the triangle is left before the next row; null while it stays",
        nullable=True,
    ),
    _scalar("element", pa.int8(), "1", "symmetry element of the frame, 0 .. 23"),
    _scalar("frame_yaw_rad", pa.float64(), "rad", "turn about the vertical, after the mirror of the element"),
    _vector("nodes", 36, "m", "canonical node positions about the centre of mass [12, 3]"),
    _vector("node_velocities", 36, "m/s", "canonical node velocities about the centre of mass [12, 3]"),
    _vector("com_velocity", 3, "m/s", "canonical centre of mass velocity"),
    _vector("target_direction", 2, "1", "canonical horizontal unit vector to the active waypoint"),
    _vector("rest_lengths", 24, "m", "canonical cable rest lengths"),
    _vector("observation", OBSERVATION_N, "1", "what a policy may see: sensors, then nodes; scaled to order one"),
    _vector("action", 24, "m", "canonical commanded rest lengths, noise included", nullable=True),
    _vector("action_mean", 24, "m", "canonical commanded rest lengths of the noise-free policy", nullable=True),
    _vector("bar_positions", 18, "m", "bar centres [6, 3]"),
    _vector("bar_orientations", 24, "1", "bar quaternions x y z w [6, 4]"),
    _vector("bar_velocities", 18, "m/s", "bar centre velocities [6, 3]"),
    _vector("bar_angular_velocities", 18, "rad/s", "bar angular velocities [6, 3]"),
)

EPISODES = _schema(
    _scalar("episode_id", pa.int64(), "1", "episode, unique in the run"),
    _scalar("iteration", pa.int32(), "1", "iteration of the run"),
    _scalar("index", pa.int32(), "1", "place of the episode in its iteration"),
    _scalar("seed", pa.int64(), "1", "root of the episode's random streams"),
    _scalar("terrain_seed", pa.int64(), "1", "seed of the ground"),
    _scalar("terrain_difficulty", pa.float64(), "1", "0 flat, 1 the paper's roughness"),
    _scalar("policy_version", pa.int32(), "1", "version of the policy that acted"),
    _scalar("noise_std_m", pa.float64(), "m", "exploration noise per cable"),
    _scalar("steps", pa.int32(), "1", "control steps taken, T"),
    _scalar("ended_by", pa.string(), "", "completed, or why the simulation was stopped"),
    _scalar("cost", pa.float64(), "m2/s2", "mean running cost over rows 1 .. T"),
    _scalar("forward_speed_m_per_s", pa.float64(), "m/s", "mean forward speed over rows 1 .. T"),
    _scalar("stuck_share", pa.float64(), "1", "stuck by speed: share of rows 1 .. T with a speed below 0.05 m/s"),
    _scalar(
        "stuck_share_by_distance",
        pa.float64(),
        "1",
        "stuck by distance: share of rows 10 .. T less than 0.05 m from the place of 1 s before; null for T < 10",
        nullable=True,
    ),
    _scalar(
        "waypoints_reached",
        pa.int32(),
        "1",
        "waypoints reached before their time was up; null where the task has directions",
        nullable=True,
    ),
    _scalar("path_length_m", pa.float64(), "m", "length of the horizontal path of the centre of mass"),
    _scalar("transitions", pa.int32(), "1", "changes of the support triangle"),
    _scalar("bar_mass_kg", pa.float64(), "kg", "mass of a bar in this episode"),
    _scalar("cable_stiffness_n_per_m", pa.float64(), "N/m", "cable stiffness in this episode"),
    _scalar("friction", pa.float64(), "1", "coefficient of friction in this episode"),
    _scalar("winch_speed_m_per_s", pa.float64(), "m/s", "winch speed in this episode"),
    _scalar("delay_steps", pa.int32(), "1", "control steps from a command to its effect"),
)

_STANDARD_ERROR = "standard error over episodes; null for a single one"
_POLICY_KL = _scalar(
    "policy_kl", pa.float64(), "nat", "mean KL divergence of the new policy from the one that sampled", nullable=True
)

ITERATIONS = _schema(
    _scalar("iteration", pa.int32(), "1", "iteration, counted from 0"),
    _scalar("policy_version", pa.int32(), "1", "version of the policy that sampled"),
    _scalar("episodes", pa.int32(), "1", "episodes sampled"),
    _scalar("steps", pa.int64(), "1", "control steps sampled"),
    _scalar("cost", pa.float64(), "m2/s2", "mean over episodes of the running cost"),
    _scalar("cost_standard_error", pa.float64(), "m2/s2", _STANDARD_ERROR, nullable=True),
    _scalar("forward_speed_m_per_s", pa.float64(), "m/s", "mean over episodes"),
    _scalar("forward_speed_standard_error", pa.float64(), "m/s", _STANDARD_ERROR, nullable=True),
    _scalar("stuck_share", pa.float64(), "1", "stuck by speed: mean over episodes"),
    _scalar(
        "waypoints_per_episode",
        pa.float64(),
        "1",
        "waypoints reached: mean over episodes; null where the task has directions",
        nullable=True,
    ),
    _scalar("segments", pa.int32(), "1", "segments cut from the episodes"),
    _scalar("classes", pa.int32(), "1", "segment classes with models of their own"),
    _scalar("modes", pa.float64(), "1", "mean number of modes per class and time step"),
    _scalar("residual", pa.float64(), "1", "mean residual of the assigned models in standard deviations"),
    _scalar("sub_trajectories", pa.int32(), "1", "sub-trajectories of the backward pass"),
    _scalar("predicted_cost_change", pa.float64(), "m2/s2", "mean predicted change of cost per step"),
    _scalar("action_change_m", pa.float64(), "m", "root mean square of u* minus the policy mean"),
    _scalar("supervised_loss", pa.float64(), "1", "final mean squared error of the supervised step"),
    _scalar("sampling_s", pa.float64(), "s", "duration"),
    _scalar("segmenting_s", pa.float64(), "s", "duration"),
    _scalar("fitting_s", pa.float64(), "s", "duration"),
    _scalar("backward_pass_s", pa.float64(), "s", "duration"),
    _scalar("supervised_s", pa.float64(), "s", "duration"),
    _scalar("supervised_loss_before", pa.float64(), "1", "the same error before the supervised step", nullable=True),
    _POLICY_KL,
    _scalar(
        "saturated_share",
        pa.float64(),
        "1",
        "share of noise-free commands at an end of the command range",
        nullable=True,
    ),
    _scalar("left_out", pa.int32(), "1", "planned episodes that kept failing and are not in the data", nullable=True),
    _scalar(
        "stuck_share_by_distance",
        pa.float64(),
        "1",
        "stuck by distance: mean over the episodes that last 1 s; null where none does",
        nullable=True,
    ),
)

CLASSES = _schema(
    _scalar("iteration", pa.int32(), "1", "iteration"),
    _scalar("kind", pa.int8(), "1", "support triangle: 0 Delta, 1 Lambda"),
    _scalar("entry_edge", pa.int8(), "1", "canonical entry edge, null for a partial segment", nullable=True),
    _scalar("exit_edge", pa.int8(), "1", "canonical exit edge, null for a partial segment", nullable=True),
    _scalar("truncated", pa.bool_(), "1", "first part of a long stay"),
    _scalar("segments", pa.int32(), "1", "segments of the class"),
    _scalar("rows", pa.int32(), "1", "control steps in these segments"),
    _scalar("time_steps", pa.int32(), "1", "aligned time steps, T_xi"),
    _scalar("pooled", pa.bool_(), "1", "too rare for models of its own: uses those pooled over its kind"),
    _scalar("modes", pa.float64(), "1", "mean number of modes per time step; null without a sample", nullable=True),
    _scalar(
        "residual",
        pa.float64(),
        "1",
        "mean residual of the assigned models in standard deviations; null without a sample",
        nullable=True,
    ),
    _scalar(
        "cost", pa.float64(), "m2/s2", "mean running cost of the states that the class's steps lead to", nullable=True
    ),
    _scalar(
        "predicted_cost_change",
        pa.float64(),
        "m2/s2",
        "mean predicted change of that cost per step; null when every step is a jump",
        nullable=True,
    ),
    _POLICY_KL,
)

TABLES = {"frames": FRAMES, "episodes": EPISODES, "iterations": ITERATIONS, "classes": CLASSES}


def vector_length(field: pa.Field) -> int | None:
    """Entries of a vector column, None for a scalar one."""
    length = (field.metadata or {}).get(b"length")
    return None if length is None else int(length)


def check(table: pa.Table, schema: pa.Schema, where: str) -> pa.Table:
    """Return `table` when it follows `schema` to the letter.

    `nullable=False` is not enforced by Arrow itself, so nulls, vector lengths and non-finite numbers are checked
    here. Raises DataError naming `where` and the first column that is missing, unknown, of another type or length,
    null without permission, or not finite.
    """
    if not table.schema.equals(schema):
        if table.schema.names != schema.names:
            raise DataError(f"{where}: columns must be {schema.names}, found {table.schema.names}")
        for field, found in zip(schema, table.schema, strict=True):
            if found.type != field.type:
                raise DataError(f"{where}: column {field.name} must be {field.type}, found {found.type}")
    rules = _rules(schema)
    for batch in table.to_batches():
        for (name, nullable, length, finite), column in zip(rules, batch.columns, strict=True):
            if column.null_count and not nullable:
                raise DataError(f"{where}: column {name} must not be null, found {column.null_count} nulls")
            if not finite and not np.isfinite(_numbers(column, length, where, name).to_numpy()).all():
                raise DataError(f"{where}: column {name} holds numbers that are not finite")
    return table


def _numbers(column: pa.Array, length: int | None, where: str, name: str) -> pa.Array:
    """What the entries that are not null hold, one after the other."""
    entries = column.drop_null() if column.null_count else column
    if length is None:
        return entries
    offsets = entries.offsets.to_numpy()
    if (offsets[1:] - offsets[:-1] != length).any():
        raise DataError(f"{where}: every entry of column {name} must hold {length} numbers")
    numbers = entries.values.slice(offsets[0], offsets[-1] - offsets[0])
    if numbers.null_count:
        raise DataError(f"{where}: column {name} holds nulls inside its vectors")
    return numbers


@cache
def _rules(schema: pa.Schema) -> list[tuple[str, bool, int | None, bool]]:
    """Of each column: its name, whether it may be null, its length if it holds vectors, whether all it holds is finite.

    Read from a schema once, since every episode is checked.
    """
    lengths = [vector_length(field) for field in schema]
    return [
        (field.name, field.nullable, length, length is None and not pa.types.is_floating(field.type))
        for field, length in zip(schema, lengths, strict=True)
    ]


def array(table: pa.Table, name: str) -> NDArray[np.generic]:
    """Column `name` as an array: [rows] for a scalar column, [non-null rows, length] for a vector column.

    A view without a copy when the column is one chunk and, if scalar, has no nulls; nullable integers become
    float64 with NaN for null.
    """
    column = table.column(name)
    chunk = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()
    length = vector_length(FRAMES.field(name)) if pa.types.is_list(column.type) else None
    flat = chunk if length is None else chunk.flatten()
    numbers: NDArray[np.generic] = flat.to_numpy(zero_copy_only=False)
    return numbers if length is None else numbers.reshape(-1, length)
