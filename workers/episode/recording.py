"""From the raw record of an episode to its Arrow tables: everything that the loop need not know is derived here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.records import Episode, EpisodePlan
from t6gps.storage.schema import EPISODES, FRAMES, vector_length
from t6gps.workers.episode.task import running_cost
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, exit_edge
from t6gps.workers.robot.symmetry import CABLES_FROM, NODES_FROM, world_map
from t6gps.workers.robot.topology import FACE_KINDS
from t6gps.workers.settings import RolloutSettings

Array = NDArray[np.float64]
STUCK_SPEED_M_PER_S = 0.05
STUCK_DISTANCE_M, STUCK_STEPS = 0.05, round(1.0 / CONTROL_STEP_S)
"""Stuck by distance: less than this far from where the centre of mass was one second before."""


@dataclass
class Record:
    """Raw record of an episode, one entry per row; `actions` and `means` have none for the last row."""

    states: list[RobotState] = field(default_factory=list)
    frames: list[SupportFrame] = field(default_factory=list)
    yaws_rad: list[float] = field(default_factory=list)
    waypoints: list[tuple[int, float, float]] = field(default_factory=list)
    observations: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.floating]] = field(default_factory=list)
    means: list[NDArray[np.floating]] = field(default_factory=list)


def canonical_vectors(vectors: Array, maps: Array, labels: NDArray[np.int64]) -> Array:
    """Relabel and map world vectors [T, n, 3] into the frames of their rows.

    `maps` [T, 3, 3] are the `world_map`s of the rows, `labels` [T, n] the rows of a FROM map.
    """
    return vectors[np.arange(len(vectors))[:, None], labels] @ maps.swapaxes(1, 2)


@dataclass(frozen=True)
class Outcome:
    """What the loop knows of an episode beside its plan and its record."""

    policy_version: int
    ended_by: str
    waypoints_reached: int
    delay_steps: int


def to_episode(record: Record, plan: EpisodePlan, outcome: Outcome, settings: RolloutSettings) -> Episode:
    """The two tables of an episode; whoever hands them on checks them."""
    rows = len(record.states)
    states = record.states
    state = RobotState(_stacked([s.bars for s in states]), _stacked([s.rest_lengths for s in states]))
    element = np.array([frame.element for frame in record.frames])
    yaw = np.array(record.yaws_rad)
    number, waypoint_x, waypoint_y = (np.array(column) for column in zip(*record.waypoints, strict=True))
    com, velocity = state.com, state.com_velocity
    to_waypoint = np.stack([waypoint_x, waypoint_y], axis=1) - com[:, :2]
    distance = np.hypot(*to_waypoint.T)
    direction = to_waypoint / distance[:, None]
    maps = world_map(element, yaw)
    forward_speed = (velocity[:, :2] * direction).sum(axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    cost = running_cost(velocity, direction, settings.task)
    frames = record.frames
    face = np.array([frame.face for frame in frames])
    transitions = np.flatnonzero(np.diff(face))
    exits: list[int | None] = [None] * rows
    for row in transitions:
        exits[row] = exit_edge(frames[row], frames[row + 1].face)
    columns: dict[str, Any] = {
        "episode_id": np.full(rows, plan.episode_id),
        "iteration": np.full(rows, plan.iteration),
        "step": np.arange(rows),
        "time_s": np.arange(rows) * CONTROL_STEP_S,
        "policy_version": np.full(rows, outcome.policy_version),
        "com_x_m": com[:, 0],
        "com_y_m": com[:, 1],
        "com_z_m": com[:, 2],
        "speed_m_per_s": speed,
        "forward_speed_m_per_s": forward_speed,
        "cost": cost,
        "waypoint": number,
        "waypoint_x_m": waypoint_x,
        "waypoint_y_m": waypoint_y,
        "waypoint_distance_m": distance,
        "face": face,
        "kind": FACE_KINDS[face],
        "entry_edge": [frame.entry_edge for frame in frames],
        "exit_edge": exits,
        "element": element,
        "frame_yaw_rad": yaw,
        "nodes": canonical_vectors(state.nodes() - com[:, None], maps, NODES_FROM[element]),
        "node_velocities": canonical_vectors(state.node_velocities() - velocity[:, None], maps, NODES_FROM[element]),
        "com_velocity": np.einsum("tij,tj->ti", maps, velocity),
        "target_direction": np.einsum("tij,tj->ti", maps[:, :2, :2], direction),
        "rest_lengths": np.take_along_axis(state.rest_lengths, CABLES_FROM[element], axis=1),
        "observation": _stacked(record.observations),
        "action": _stacked(record.actions),
        "action_mean": _stacked(record.means),
        "bar_positions": state.bar_positions,
        "bar_orientations": state.bar_orientations,
        "bar_velocities": state.bar_velocities,
        "bar_angular_velocities": state.bar_angular_velocities,
    }
    moved = slice(1, None)
    path = np.hypot(*np.diff(com[:, :2], axis=0).T).sum()
    summary: dict[str, object] = {
        "episode_id": plan.episode_id,
        "iteration": plan.iteration,
        "index": plan.index,
        "seed": plan.seed,
        "terrain_seed": plan.terrain_seed,
        "terrain_difficulty": plan.terrain_difficulty,
        "policy_version": outcome.policy_version,
        "noise_std_m": plan.noise_std_m,
        "steps": rows - 1,
        "ended_by": outcome.ended_by,
        "cost": float(cost[moved].mean()),
        "forward_speed_m_per_s": float(forward_speed[moved].mean()),
        "stuck_share": float((speed[moved] < STUCK_SPEED_M_PER_S).mean()),
        "stuck_share_by_distance": stuck_share_by_distance(com),
        "waypoints_reached": outcome.waypoints_reached,
        "path_length_m": float(path),
        "transitions": len(transitions),
        "bar_mass_kg": settings.robot.bar_mass_kg,
        "cable_stiffness_n_per_m": settings.robot.cable_stiffness_n_per_m,
        "friction": settings.robot.friction,
        "winch_speed_m_per_s": settings.robot.winch_speed_m_per_s,
        "delay_steps": outcome.delay_steps,
    }
    return Episode(
        pa.table([_column(columns[f.name], f, rows) for f in FRAMES], schema=FRAMES),
        pa.table([pa.array([summary[f.name]], f.type) for f in EPISODES], schema=EPISODES),
    )


def stuck_share_by_distance(com: Array) -> float | None:
    """Share of places [T + 1, 3] (m) less than 0.05 m from the one 1 s before; None for a path shorter than that.

    A robot that rocks on the spot has speed but gets nowhere.
    """
    if len(com) <= STUCK_STEPS:
        return None
    distance = np.linalg.norm(com[STUCK_STEPS:] - com[:-STUCK_STEPS], axis=1)
    return float((distance < STUCK_DISTANCE_M).mean())


def _stacked(rows: list[NDArray[Any]]) -> NDArray[Any]:
    """What numpy.stack gives, several times faster for many small arrays."""
    return np.concatenate(rows).reshape(len(rows), *rows[0].shape)


def _column(values: Any, target: pa.Field, rows: int) -> pa.Array:
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
