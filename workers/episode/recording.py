"""From the raw record of an episode to its Arrow tables: everything that the loop need not know is derived here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.fields import vector_length
from t6gps.storage.records import Episode, EpisodePlan
from t6gps.storage.schema import EPISODES, FRAMES
from t6gps.workers.episode.task import running_cost
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, exit_edge
from t6gps.workers.robot.symmetry import CABLES_FROM, NODES_FROM, world_map
from t6gps.workers.robot.topology import FACE_KINDS
from t6gps.workers.settings import RolloutSettings, TaskSettings

Array = NDArray[np.float64]
Column = NDArray[np.generic] | Sequence[int | None]
Scalar = TypeVar("Scalar", bound=np.generic)

STUCK_SPEED_M_PER_S = 0.05
"""Stuck by speed: slower than this."""

STUCK_DISTANCE_M = 0.05
"""Stuck by distance: less than this far from where the centre of mass was one second before."""

STUCK_STEPS = round(1.0 / CONTROL_STEP_S)
"""That second in control steps."""


@dataclass
class Record:
    """Raw record of an episode, one entry per row; `actions` and `means` have none for the last row."""

    states: list[RobotState] = field(default_factory=list)
    frames: list[SupportFrame] = field(default_factory=list)
    yaws_rad: list[float] = field(default_factory=list)
    waypoints: list[tuple[int, float, float]] = field(default_factory=list)
    observations: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    means: list[Array] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the loop knows of an episode beside its plan and its record."""

    policy_version: int
    ended_by: str
    waypoints_reached: int
    delay_steps: int


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """The rows of a record as arrays, and what both tables derive from them.

    state, com, velocity      bars and rest lengths; centre of mass [T + 1, 3] (m) and its velocity (m/s)
    number, waypoint          number of the active waypoint [T + 1] and its place [T + 1, 2] (m)
    distance, direction       to the waypoint: distance [T + 1] (m), horizontal unit vector [T + 1, 2]
    speed, forward_speed      of the centre of mass, in all and towards the waypoint [T + 1] (m/s)
    cost                      running cost [T + 1] (m2/s2)
    """

    state: RobotState
    com: Array
    velocity: Array
    number: NDArray[np.int64]
    waypoint: Array
    distance: Array
    direction: Array
    speed: Array
    forward_speed: Array
    cost: Array


def to_episode(
    record: Record, plan: EpisodePlan, outcome: Outcome, settings: RolloutSettings, ground: Terrain | None
) -> Episode:
    """The two tables of an episode on its ground, None for the plane; whoever hands them on checks them."""
    motion = _motion(record, settings.task)
    shared = {
        "episode_id": plan.episode_id,
        "iteration": plan.iteration,
        "policy_version": outcome.policy_version,
    }
    rows = len(record.states)
    columns: dict[str, Column] = {name: np.full(rows, value) for name, value in shared.items()}
    columns |= _world_columns(motion) | _canonical_columns(record, motion) | _ground_columns(motion, ground)
    summary: dict[str, object] = shared | _summary(record, motion, plan, outcome, settings)
    return Episode(
        pa.table([_arrow(columns[f.name], f, rows) for f in FRAMES], schema=FRAMES),
        pa.table([pa.array([summary[f.name]], f.type) for f in EPISODES], schema=EPISODES),
    )


def _motion(record: Record, task: TaskSettings) -> _Motion:
    states = record.states
    state = RobotState(_stacked([s.bars for s in states]), _stacked([s.rest_lengths for s in states]))
    number, waypoint_x, waypoint_y = (np.array(column) for column in zip(*record.waypoints, strict=True))
    com, velocity = state.com, state.com_velocity
    waypoint = np.stack([waypoint_x, waypoint_y], axis=1)
    to_waypoint = waypoint - com[:, :2]
    distance = np.hypot(*to_waypoint.T)
    direction = to_waypoint / distance[:, None]
    return _Motion(
        state=state,
        com=com,
        velocity=velocity,
        number=number,
        waypoint=waypoint,
        distance=distance,
        direction=direction,
        speed=np.linalg.norm(velocity, axis=1),
        forward_speed=(velocity[:, :2] * direction).sum(axis=1),
        cost=running_cost(velocity, direction, task),
    )


def _world_columns(motion: _Motion) -> dict[str, Column]:
    """Columns that hold world coordinates or none."""
    rows = len(motion.com)
    return {
        "step": np.arange(rows),
        "time_s": np.arange(rows) * CONTROL_STEP_S,
        "com_x_m": motion.com[:, 0],
        "com_y_m": motion.com[:, 1],
        "com_z_m": motion.com[:, 2],
        "speed_m_per_s": motion.speed,
        "forward_speed_m_per_s": motion.forward_speed,
        "cost": motion.cost,
        "waypoint": motion.number,
        "waypoint_x_m": motion.waypoint[:, 0],
        "waypoint_y_m": motion.waypoint[:, 1],
        "waypoint_distance_m": motion.distance,
        "bar_positions": motion.state.bar_positions,
        "bar_orientations": motion.state.bar_orientations,
        "bar_velocities": motion.state.bar_velocities,
        "bar_angular_velocities": motion.state.bar_angular_velocities,
    }


def _ground_columns(motion: _Motion, ground: Terrain | None) -> dict[str, Column]:
    """The ground under the centre of mass; the plane lies at height 0."""
    x, y = motion.com[:, 0], motion.com[:, 1]
    return {
        "ground_height_m": np.zeros(len(x)) if ground is None else ground.height(x, y),
        "ground_slope_deg": np.zeros(len(x)) if ground is None else ground.slope_deg(x, y),
    }


def _canonical_columns(record: Record, motion: _Motion) -> dict[str, Column]:
    """Support triangle and frame of each row, and what is seen and commanded in that frame."""
    frames, state = record.frames, motion.state
    face = np.array([frame.face for frame in frames])
    element = np.array([frame.element for frame in frames])
    yaw = np.array(record.yaws_rad)
    maps, nodes_from = world_map(element, yaw), NODES_FROM[element]
    exits: list[int | None] = [None] * len(frames)
    for row in np.flatnonzero(np.diff(face)):
        exits[row] = exit_edge(frames[row], frames[row + 1].face)
    return {
        "face": face,
        "kind": FACE_KINDS[face],
        "entry_edge": [frame.entry_edge for frame in frames],
        "exit_edge": exits,
        "element": element,
        "frame_yaw_rad": yaw,
        "nodes": canonical_vectors(state.nodes() - motion.com[:, None], maps, nodes_from),
        "node_velocities": canonical_vectors(state.node_velocities() - motion.velocity[:, None], maps, nodes_from),
        "com_velocity": np.einsum("tij,tj->ti", maps, motion.velocity),
        "target_direction": np.einsum("tij,tj->ti", maps[:, :2, :2], motion.direction),
        "rest_lengths": np.take_along_axis(state.rest_lengths, CABLES_FROM[element], axis=1),
        "observation": _stacked(record.observations),
        "action": _stacked(record.actions),
        "action_mean": _stacked(record.means),
    }


def _summary(
    record: Record, motion: _Motion, plan: EpisodePlan, outcome: Outcome, settings: RolloutSettings
) -> dict[str, object]:
    """The row of the episode; means are over the rows that an action led to."""
    moved = slice(1, None)
    faces = [frame.face for frame in record.frames]
    return {
        "index": plan.index,
        "seed": plan.seed,
        "terrain_seed": plan.terrain_seed,
        "terrain_difficulty": plan.terrain_difficulty,
        "noise_std_m": plan.noise_std_m,
        "steps": len(record.states) - 1,
        "ended_by": outcome.ended_by,
        "cost": float(motion.cost[moved].mean()),
        "forward_speed_m_per_s": float(motion.forward_speed[moved].mean()),
        "stuck_share": float((motion.speed[moved] < STUCK_SPEED_M_PER_S).mean()),
        "stuck_share_by_distance": stuck_share_by_distance(motion.com),
        "waypoints_reached": None if settings.task.directions is not None else outcome.waypoints_reached,
        "path_length_m": float(np.hypot(*np.diff(motion.com[:, :2], axis=0).T).sum()),
        "transitions": int(np.count_nonzero(np.diff(faces))),
        "bar_mass_kg": settings.robot.bar_mass_kg,
        "cable_stiffness_n_per_m": settings.robot.cable_stiffness_n_per_m,
        "friction": settings.robot.friction,
        "winch_speed_m_per_s": settings.robot.winch_speed_m_per_s,
        "delay_steps": outcome.delay_steps,
    }


def canonical_vectors(vectors: Array, maps: Array, labels: NDArray[np.int64]) -> Array:
    """Relabel and map world vectors [T, n, 3] into the frames of their rows.

    `maps` [T, 3, 3] are the `world_map`s of the rows, `labels` [T, n] the rows of a FROM map.
    """
    return vectors[np.arange(len(vectors))[:, None], labels] @ maps.swapaxes(1, 2)


def stuck_share_by_distance(com: Array) -> float | None:
    """Share of places [T + 1, 3] (m) less than 0.05 m from the one 1 s before; None for a path shorter than that.

    A robot that rocks on the spot has speed but gets nowhere.
    """
    return None if len(com) <= STUCK_STEPS else float(stuck_by_distance(com).mean())


def stuck_by_distance(com: Array) -> NDArray[np.bool_]:
    """Whether places 10 .. T of [T + 1, 3] (m) are less than 0.05 m from the one 1 s before."""
    return np.asarray(np.linalg.norm(com[STUCK_STEPS:] - com[:-STUCK_STEPS], axis=1) < STUCK_DISTANCE_M)


def _stacked(rows: Sequence[NDArray[Scalar]]) -> NDArray[Scalar]:
    """What numpy.stack gives, several times faster for many small arrays."""
    return np.concatenate(rows).reshape(len(rows), *rows[0].shape)


def _arrow(values: Column, target: pa.Field, rows: int) -> pa.Array:
    """Column of `rows` entries; where a vector column has fewer values, the last entries are null."""
    length = vector_length(target)
    if length is None:
        if isinstance(values, np.ndarray):
            values = values.astype(target.type.to_pandas_dtype(), copy=False)  # Arrow's own conversion is slower
        return pa.array(values, target.type)
    filled = len(values)
    flat = np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
    offsets = np.arange(0, (rows + 1) * length, length, dtype=np.int32)
    mask = None
    if filled < rows:
        offsets[filled:] = filled * length
        mask = pa.array(np.arange(rows) >= filled)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(flat), type=target.type, mask=mask)
