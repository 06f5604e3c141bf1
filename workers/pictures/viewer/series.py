"""Numbers and states over time: columns of the frames, the 24 cables, and segments."""

from __future__ import annotations

import numpy as np
import rerun as rr

from t6gps.storage import fields, schema
from t6gps.workers.pictures.motion import Motion
from t6gps.workers.pictures.stays import stays, stuck
from t6gps.workers.pictures.viewer import colours
from t6gps.workers.pictures.viewer.rows import Rows
from t6gps.workers.robot.topology import CABLES, CABLES_N, KIND_NAMES

IDENTITY = {"evaluation_id", "episode_id", "iteration", "policy_version", "step", "time_s"}
"""Scalar columns that say which row it is, and are no series."""


def log_frames(rows: Rows) -> None:
    """Every scalar column of the frames, where it is not null."""
    for column in rows.frames.schema:
        if column.name in IDENTITY or fields.vector_length(column) is not None:
            continue
        values = rows.frames[column.name]
        there = np.flatnonzero(values.is_valid().to_numpy())
        if len(there):
            line = rr.SeriesLines(names=[f"{column.name} ({column.metadata[b'unit'].decode()})"])
            rows.log(f"frames/{column.name}", line)
            numbers = values.drop_null().to_numpy().astype(np.float64)
            rows.send(f"frames/{column.name}", rr.Scalars.columns(scalars=numbers), there)


def log_cables(rows: Rows, moved: Motion) -> None:
    """Tension (N), command and rest length (m) of each cable; the last row has no command."""
    lines = rr.SeriesLines(names=[f"cable {cable}: nodes {a} and {b}" for cable, (a, b) in enumerate(CABLES)])
    series = {"tension_n": moved.tensions, "command_m": moved.commands, "rest_length_m": moved.rest_lengths}
    for name, of_cables in series.items():
        rows.log(f"cables/{name}", lines)
        numbers = rr.Scalars.columns(scalars=of_cables.ravel()).partition([CABLES_N] * len(of_cables))
        rows.send(f"cables/{name}", numbers, np.arange(len(of_cables)))


def log_segments(rows: Rows, moved: Motion) -> None:
    """Kind of the support triangle, class of the stay on it, and whether the robot is stuck."""
    kind = schema.array(rows.frames, "kind")
    rows.log("segments/kind", rr.StateConfiguration(values=KIND_NAMES, colors=colours.KIND_COLOURS))
    rows.send_changes("segments/kind", [KIND_NAMES[k] for k in kind])
    found = list(stays(rows.frames))
    classes = rr.StateChange.columns(state=[stay.name for stay in found])
    rows.send("segments/class", classes, np.array([stay.start for stay in found]))
    held = stuck(moved.com)
    rows.log("segments/stuck", rr.StateConfiguration(values=["moving", "stuck"], colors=[colours.GREY, colours.RED]))
    rows.send_changes("segments/stuck", ["stuck" if row else "moving" for row in held])
