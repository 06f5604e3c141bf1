"""Arrow schemas of everything a run keeps, with units in the field metadata.

Row t of `frames` holds state t, the action taken at t, and nothing of what followed; the last state of an episode
(row T) has null actions. Canonical columns are expressed in the symmetry-reduced frame of that row: labels permuted
by the row's `element`, the world mirrored when the element is improper, and turned about the vertical. The frame
stays the same while the support triangle stays the same. Columns without the word canonical are world quantities.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.fields import numbers, scalar, vector, vector_length

Number = TypeVar("Number", np.float32, np.float64)

SCHEMA_VERSION = 7
"""Grows with every change. Versions 2, 3, 5 and 6 added columns at the end of `iterations`, version 2 of `classes`,
version 6 of `frames`; they are nullable, since older runs have none. Version 4 added the nodes to `observation`.
Version 5 has null where older versions had 0 for what there is none of: standard errors of one episode, waypoints of a
far direction, modes and residual of a class without a sample. Version 6 added `models`, `policies`, the tables of
evaluations, and `realised_cost_change` to `iterations`; version 7 the last five quantities to `evaluations`."""
SENSORS_N, SHAPE_N = 47, 36
OBSERVATION_N = SENSORS_N + SHAPE_N
"""Entries of an observation: kind, 24 rest lengths, 18 angular velocities, target and track direction; 12 nodes."""
REST_LENGTHS, TARGET, NODES = slice(1, 25), slice(43, 45), slice(SENSORS_N, OBSERVATION_N)
"""Of these the rest lengths about the nominal one, the target direction, and the nodes."""
REST_LENGTH_SCALE_M, NODE_SCALE_M = 0.2, 0.5
"""Their units."""


def reached(
    command: NDArray[Number], observation: NDArray[np.float32], nominal_m: float, reach_m: float
) -> NDArray[Number]:
    """What winches come to of canonical commands [..., 24] (m), if each comes `reach_m` from its rest length at most.

    These are in observations [..., 83], about the nominal one.
    """
    rest_lengths = observation[..., REST_LENGTHS] * np.float32(REST_LENGTH_SCALE_M) + np.float32(nominal_m)
    return np.clip(command, rest_lengths - np.float32(reach_m), rest_lengths + np.float32(reach_m))


def _schema(*fields: pa.Field) -> pa.Schema:
    return pa.schema(fields, {"t6gps_schema_version": str(SCHEMA_VERSION)})


RUN = scalar("run", pa.string(), "", "name of the run")
"""The first column of every table in a query over runs; in the files of a run it does not stand."""

FRAMES = _schema(
    scalar("episode_id", pa.int64(), "1", "episode, unique in the run"),
    scalar("iteration", pa.int32(), "1", "iteration of the run that sampled the episode"),
    scalar("step", pa.int32(), "1", "control step t = 0 .. T, one row each"),
    scalar("time_s", pa.float64(), "s", "time since the start of the episode"),
    scalar("policy_version", pa.int32(), "1", "version of the policy that acts"),
    scalar("com_x_m", pa.float64(), "m", "centre of mass, x"),
    scalar("com_y_m", pa.float64(), "m", "centre of mass, y"),
    scalar("com_z_m", pa.float64(), "m", "centre of mass, height"),
    scalar("speed_m_per_s", pa.float64(), "m/s", "norm of the centre of mass velocity"),
    scalar("forward_speed_m_per_s", pa.float64(), "m/s", "centre of mass velocity towards the waypoint"),
    scalar("cost", pa.float64(), "m2/s2", "running cost of state t (paper Sec. IV-A)"),
    scalar("waypoint", pa.int32(), "1", "number of the active waypoint, counted from 0"),
    scalar("waypoint_x_m", pa.float64(), "m", "active waypoint, x"),
    scalar("waypoint_y_m", pa.float64(), "m", "active waypoint, y"),
    scalar("waypoint_distance_m", pa.float64(), "m", "horizontal distance to the active waypoint"),
    scalar("face", pa.int8(), "1", "support triangle under the centre of mass, 0 .. 19"),
    scalar("kind", pa.int8(), "1", "kind of the support triangle: 0 Delta, 1 Lambda"),
    scalar("entry_edge", pa.int8(), "1", "canonical edge through which the triangle was entered", nullable=True),
    scalar(
        "exit_edge",
        pa.int8(),
        "1",
        "canonical edge through which the triangle is left before the next row; null while it stays",
        nullable=True,
    ),
    scalar("element", pa.int8(), "1", "symmetry element of the frame, 0 .. 23"),
    scalar("frame_yaw_rad", pa.float64(), "rad", "turn about the vertical, after the mirror of the element"),
    vector("nodes", 36, "m", "canonical node positions about the centre of mass [12, 3]"),
    vector("node_velocities", 36, "m/s", "canonical node velocities about the centre of mass [12, 3]"),
    vector("com_velocity", 3, "m/s", "canonical centre of mass velocity"),
    vector("target_direction", 2, "1", "canonical horizontal unit vector to the active waypoint"),
    vector("rest_lengths", 24, "m", "canonical cable rest lengths"),
    vector("observation", OBSERVATION_N, "1", "what a policy may see: sensors, then nodes; scaled to order one"),
    vector("action", 24, "m", "canonical commanded rest lengths, noise included", nullable=True),
    vector("action_mean", 24, "m", "canonical commanded rest lengths of the noise-free policy", nullable=True),
    vector("bar_positions", 18, "m", "bar centres [6, 3]"),
    vector("bar_orientations", 24, "1", "bar quaternions x y z w [6, 4]"),
    vector("bar_velocities", 18, "m/s", "bar centre velocities [6, 3]"),
    vector("bar_angular_velocities", 18, "rad/s", "bar angular velocities [6, 3]"),
    scalar("ground_height_m", pa.float64(), "m", "height of the ground under the centre of mass", nullable=True),
    scalar("ground_slope_deg", pa.float64(), "deg", "slope of the ground under the centre of mass", nullable=True),
)

EPISODES = _schema(
    scalar("episode_id", pa.int64(), "1", "episode, unique in the run"),
    scalar("iteration", pa.int32(), "1", "iteration of the run"),
    scalar("index", pa.int32(), "1", "place of the episode in its iteration"),
    scalar("seed", pa.int64(), "1", "root of the episode's random streams"),
    scalar("terrain_seed", pa.int64(), "1", "seed of the ground"),
    scalar("terrain_difficulty", pa.float64(), "1", "0 flat, 1 the paper's roughness"),
    scalar("policy_version", pa.int32(), "1", "version of the policy that acted"),
    scalar("noise_std_m", pa.float64(), "m", "exploration noise per cable"),
    scalar("steps", pa.int32(), "1", "control steps taken, T"),
    scalar("ended_by", pa.string(), "", "completed, or why the simulation was stopped"),
    scalar("cost", pa.float64(), "m2/s2", "mean running cost over rows 1 .. T"),
    scalar("forward_speed_m_per_s", pa.float64(), "m/s", "mean forward speed over rows 1 .. T"),
    scalar("stuck_share", pa.float64(), "1", "stuck by speed: share of rows 1 .. T with a speed below 0.05 m/s"),
    scalar(
        "stuck_share_by_distance",
        pa.float64(),
        "1",
        "stuck by distance: share of rows 10 .. T less than 0.05 m from the place of 1 s before; null for T < 10",
        nullable=True,
    ),
    scalar(
        "waypoints_reached",
        pa.int32(),
        "1",
        "waypoints reached before their time was up; null where the task has directions",
        nullable=True,
    ),
    scalar("path_length_m", pa.float64(), "m", "length of the horizontal path of the centre of mass"),
    scalar("transitions", pa.int32(), "1", "changes of the support triangle"),
    scalar("bar_mass_kg", pa.float64(), "kg", "mass of a bar in this episode"),
    scalar("cable_stiffness_n_per_m", pa.float64(), "N/m", "cable stiffness in this episode"),
    scalar("friction", pa.float64(), "1", "coefficient of friction in this episode"),
    scalar("winch_speed_m_per_s", pa.float64(), "m/s", "winch speed in this episode"),
    scalar("delay_steps", pa.int32(), "1", "control steps from a command to its effect"),
)

_STANDARD_ERROR = "standard error over episodes; null for a single one"
_POLICY_KL = scalar(
    "policy_kl", pa.float64(), "nat", "mean KL divergence of the new policy from the one that sampled", nullable=True
)

ITERATIONS = _schema(
    scalar("iteration", pa.int32(), "1", "iteration, counted from 0"),
    scalar("policy_version", pa.int32(), "1", "version of the policy that sampled"),
    scalar("episodes", pa.int32(), "1", "episodes sampled"),
    scalar("steps", pa.int64(), "1", "control steps sampled"),
    scalar("cost", pa.float64(), "m2/s2", "mean over episodes of the running cost"),
    scalar("cost_standard_error", pa.float64(), "m2/s2", _STANDARD_ERROR, nullable=True),
    scalar("forward_speed_m_per_s", pa.float64(), "m/s", "mean over episodes"),
    scalar("forward_speed_standard_error", pa.float64(), "m/s", _STANDARD_ERROR, nullable=True),
    scalar("stuck_share", pa.float64(), "1", "stuck by speed: mean over episodes"),
    scalar(
        "waypoints_per_episode",
        pa.float64(),
        "1",
        "waypoints reached: mean over episodes; null where the task has directions",
        nullable=True,
    ),
    scalar("segments", pa.int32(), "1", "segments cut from the episodes"),
    scalar("classes", pa.int32(), "1", "segment classes with models of their own"),
    scalar("modes", pa.float64(), "1", "mean number of modes per class and time step"),
    scalar("residual", pa.float64(), "1", "mean residual of the assigned models in standard deviations"),
    scalar("sub_trajectories", pa.int32(), "1", "sub-trajectories of the backward pass"),
    scalar("predicted_cost_change", pa.float64(), "m2/s2", "mean predicted change of cost per step"),
    scalar("action_change_m", pa.float64(), "m", "root mean square of u* minus the policy mean"),
    scalar("supervised_loss", pa.float64(), "1", "final mean squared error of the supervised step"),
    scalar("sampling_s", pa.float64(), "s", "duration"),
    scalar("segmenting_s", pa.float64(), "s", "duration"),
    scalar("fitting_s", pa.float64(), "s", "duration"),
    scalar("backward_pass_s", pa.float64(), "s", "duration"),
    scalar("supervised_s", pa.float64(), "s", "duration"),
    scalar("supervised_loss_before", pa.float64(), "1", "the same error before the supervised step", nullable=True),
    _POLICY_KL,
    scalar(
        "saturated_share",
        pa.float64(),
        "1",
        "share of noise-free commands at an end of the command range",
        nullable=True,
    ),
    scalar("left_out", pa.int32(), "1", "planned episodes that kept failing and are not in the data", nullable=True),
    scalar(
        "stuck_share_by_distance",
        pa.float64(),
        "1",
        "stuck by distance: mean over the episodes that last 1 s; null where none does",
        nullable=True,
    ),
    scalar(
        "realised_cost_change",
        pa.float64(),
        "m2/s2",
        "cost minus that of the iteration that trained the policy and promised a change; null for the untrained one",
        nullable=True,
    ),
)

CLASSES = _schema(
    scalar("iteration", pa.int32(), "1", "iteration"),
    scalar("kind", pa.int8(), "1", "support triangle: 0 Delta, 1 Lambda"),
    scalar("entry_edge", pa.int8(), "1", "canonical entry edge, null for a partial segment", nullable=True),
    scalar("exit_edge", pa.int8(), "1", "canonical exit edge, null for a partial segment", nullable=True),
    scalar("truncated", pa.bool_(), "1", "first part of a long stay"),
    scalar("segments", pa.int32(), "1", "segments of the class"),
    scalar("rows", pa.int32(), "1", "control steps in these segments"),
    scalar("time_steps", pa.int32(), "1", "aligned time steps, T_xi"),
    scalar("pooled", pa.bool_(), "1", "too rare for models of its own: uses those pooled over its kind"),
    scalar("modes", pa.float64(), "1", "mean number of modes per time step; null without a sample", nullable=True),
    scalar(
        "residual",
        pa.float64(),
        "1",
        "mean residual of the assigned models in standard deviations; null without a sample",
        nullable=True,
    ),
    scalar(
        "cost", pa.float64(), "m2/s2", "mean running cost of the states that the class's steps lead to", nullable=True
    ),
    scalar(
        "predicted_cost_change",
        pa.float64(),
        "m2/s2",
        "mean predicted change of that cost per step; null when every step is a jump",
        nullable=True,
    ),
    _POLICY_KL,
)

POLICIES = _schema(
    scalar("version", pa.int32(), "1", "version of the policy"),
    scalar("iteration", pa.int32(), "1", "iteration that made it; null for the untrained one", nullable=True),
    scalar("parent", pa.int32(), "1", "version that it was trained from; null for the untrained one", nullable=True),
    scalar("sha256", pa.string(), "", "SHA-256 of `weights` as little-endian numbers of 4 bytes"),
    scalar("offset_m", pa.float64(), "m", "rest length that a zero output of the network stands for"),
    scalar("scale_m", pa.float64(), "m", "rest length per unit of output"),
    numbers("layers", pa.int32(), "1", "widths of the layers: observation, hidden ones, action"),
    numbers("weights", pa.float32(), "1", "layer by layer: weight [outputs, inputs] row by row, then bias [outputs]"),
)

MODELS = _schema(
    scalar("iteration", pa.int32(), "1", "iteration whose episodes it is fitted to"),
    scalar("bin", pa.int32(), "1", "group of samples with models of their own, unique in the iteration"),
    scalar("kind", pa.int8(), "1", "of the class, as in `classes`; null where samples are grouped otherwise", True),
    scalar("entry_edge", pa.int8(), "1", "of the class; null for a partial segment or several classes", True),
    scalar("exit_edge", pa.int8(), "1", "of the class; null for a partial segment", True),
    scalar("truncated", pa.bool_(), "1", "of the class", True),
    scalar("pooled", pa.bool_(), "1", "of all classes of that kind and exit without models of their own", True),
    scalar("step", pa.int32(), "1", "aligned time step in the class"),
    scalar("mode", pa.int32(), "1", "mode in the step, counted from 0"),
    scalar("samples", pa.int32(), "1", "samples that it explains best"),
    scalar("residual", pa.float64(), "1", "their mean residual in standard deviations; null without any", True),
    numbers("dynamics_matrix", pa.float32(), "mixed", "F of x' = F [x; u] + f, row by row [nx, nx + nu] (Sec. III-D)"),
    numbers("dynamics_offset", pa.float32(), "mixed", "its f [nx]"),
    numbers("policy_matrix", pa.float32(), "mixed", "P of the mean action P x + p, row by row [nu, nx]"),
    numbers("policy_offset", pa.float32(), "m", "its p [nu]"),
    numbers("action_variance", pa.float32(), "m2", "diagonal of S, the variance of the action [nu]"),
)

_EVALUATION_ID = scalar("evaluation_id", pa.int32(), "1", "evaluation, unique in the run")


def _of_evaluations(of_run: pa.Schema) -> pa.Schema:
    """Columns of an evaluation's episodes: those of training, but for the iteration."""
    return _schema(_EVALUATION_ID, *(field for field in of_run if field.name != "iteration"))


def _estimate(name: str, unit: str, text: str) -> tuple[pa.Field, pa.Field]:
    return (
        scalar(name, pa.float64(), unit, f"{text}: mean over episodes; null where none has it", nullable=True),
        scalar(f"{name}_standard_error", pa.float64(), unit, _STANDARD_ERROR, nullable=True),
    )


EVALUATIONS = _schema(
    _EVALUATION_ID,
    scalar("purpose", pa.string(), "", "training: ended it; condition: of a study; eval: asked for"),
    scalar("condition", pa.string(), "", "name of a study's condition", nullable=True),
    scalar("policy_version", pa.int32(), "1", "version of the policy that acts"),
    scalar("episodes", pa.int32(), "1", "noise-free episodes"),
    scalar("seed", pa.int64(), "1", "root of the seeds of starts and waypoints"),
    scalar("terrain_seed", pa.int64(), "1", "root of the seeds of the ground alone", nullable=True),
    scalar("settings", pa.string(), "", "what differs from the run's settings, as JSON by dotted key"),
    scalar("engine", pa.string(), "", "simulator"),
    scalar("commit", pa.string(), "", "commit or version of t6gps"),
    scalar("made_at", pa.string(), "", "when it ended, UTC in ISO 8601"),
    *_estimate("forward_speed_m_per_s", "m/s", "mean forward speed"),
    *_estimate("stuck_share_by_distance", "1", "stuck by distance"),
    *_estimate("stuck_share_by_speed", "1", "stuck by speed"),
    *_estimate("waypoints_per_episode", "1", "waypoints reached"),
    *_estimate("cost", "m2/s2", "running cost"),
    *_estimate("speed_over_winch_speed", "1", "mean forward speed over the largest rate of a rest length"),
    *_estimate("bar_lengths_per_s", "1/s", "mean forward speed in bar lengths"),
    *_estimate("cost_of_transport", "1", "work of the winches over weight times path of the centre of mass"),
    *_estimate("slip_per_metre", "1", "path that feet slide over path of the centre of mass"),
    *_estimate("sunk_cable_share", "1", "share of rows 1 .. T in which a cable lies more than 2 cm below the ground"),
)
EVALUATION_EPISODES = _of_evaluations(EPISODES)
EVALUATION_FRAMES = _of_evaluations(FRAMES)

OF_ITERATIONS = {
    "frames": FRAMES,
    "episodes": EPISODES,
    "iterations": ITERATIONS,
    "classes": CLASSES,
    "models": MODELS,
    "policies": POLICIES,
}
"""A file for each iteration."""
OF_EVALUATIONS = {
    "evaluations": EVALUATIONS,
    "evaluation_episodes": EVALUATION_EPISODES,
    "evaluation_frames": EVALUATION_FRAMES,
}
"""A file for each evaluation."""
TABLES = {**OF_ITERATIONS, **OF_EVALUATIONS}
YOUNGER = {"models": 6, "policies": 6}
"""Tables that runs of a version before this one have not, or only of later iterations."""


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
