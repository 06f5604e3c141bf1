"""What the action value is learned from: the transitions of an iteration, whatever policy made them.

The wide part of a row, [s; action] and rest lengths, is 680 bytes. A large iteration that is over is filed away: each
gradient step wants few of its rows, and three such iterations would fill the memory.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import pyarrow as pa
import torch

from t6gps.learner import policy
from t6gps.learner.algorithm import features
from t6gps.learner.algorithm.features import vectors
from t6gps.learner.rows import VELOCITY_N, Columns, Flags, Floats, Ints, Rows, pieces
from t6gps.storage import fields, schema
from t6gps.storage.errors import RunError

STATE = ("observation", "com_velocity", "node_velocities")
"""Columns of `frames` that make up s."""
OBSERVATION_N, *_, ACTION_N = LENGTHS = [
    fields.vector_length(schema.FRAMES.field(name)) or 0 for name in (*STATE, "action")
]
INPUTS_N = sum(LENGTHS)
"""Entries of [s; e]."""
MOVED = slice(INPUTS_N - ACTION_N, INPUTS_N)
"""Where e is among them."""
COLUMNS = (*features.COLUMNS, "frame_yaw_rad", "element")
"""What a resumed run reads of `frames`."""
HELD_ROWS = 2**18
"""Iterations of more rows are filed away when they are over; those of the paper (75,000) stay in memory."""


class Wide(Protocol):
    """The wide part of rows."""

    def take(self, rows: Ints) -> tuple[Floats, Floats]:
        """[s; action] [m, ni] and rest lengths [m, nu] (m) of rows [m]."""


@dataclass(frozen=True)
class Held:
    """Rows in memory: the parts of [s; action], each [n, ...], and rest lengths [n, nu]."""

    parts: tuple[Floats, ...]
    rest_lengths: Floats

    def take(self, rows: Ints) -> tuple[Floats, Floats]:
        return np.hstack([part[rows] for part in self.parts]), self.rest_lengths[rows]


class Filed:
    """Rows in a temporary file without a name, in the folder TMPDIR; it goes with the last reference to it.

    Raises RunError when the file cannot be written.
    """

    def __init__(self, held: Held) -> None:
        try:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  (it stays open as long as the rows are wanted)
            weakref.finalize(self, self._file.close)
            for part in pieces(np.arange(len(held.rest_lengths)), policy.ROWS):
                np.hstack(held.take(part)).tofile(self._file)
            self._file.flush()
        except OSError as error:
            raise RunError(
                f"{len(held.rest_lengths)} transitions cannot be filed away in {tempfile.gettempdir()}: {error}; "
                "free some space there, or let TMPDIR name another folder"
            ) from error

    def take(self, rows: Ints) -> tuple[Floats, Floats]:
        records = np.empty((len(rows), INPUTS_N + ACTION_N), dtype=np.float32)
        size, file = records.itemsize * records.shape[1], self._file.fileno()
        places = zip(records, rows.tolist(), strict=True)
        read_n = sum(os.preadv(file, [record.data], row * size) for record, row in places)
        if read_n != records.nbytes:
            raise RunError(f"of {records.nbytes} bytes of filed transitions {read_n} came back; their file was cut off")
        return records[:, :INPUTS_N].copy(), records[:, INPUTS_N:].copy()


@dataclass(frozen=True)
class Several:
    """Rows of several iterations, one after the other; each of them with the number of its first row."""

    parts: Sequence[tuple[int, Wide]]

    def take(self, rows: Ints) -> tuple[Floats, Floats]:
        inputs = np.empty((len(rows), INPUTS_N), dtype=np.float32)
        rest_lengths = np.empty((len(rows), ACTION_N), dtype=np.float32)
        firsts = [first for first, _ in self.parts]
        of = np.searchsorted(firsts, rows, side="right") - 1
        for number, (first, wide) in enumerate(self.parts):
            chosen = np.flatnonzero(of == number)
            if len(chosen):
                inputs[chosen], rest_lengths[chosen] = wide.take(rows[chosen] - first)
        return inputs, rest_lengths


@dataclass(frozen=True)
class Transitions:
    """Rows of episodes [n], in order.

    wide           [s; action] and rest lengths
    com_velocity   canonical [n, 3] (m/s)
    turn, side     a horizontal direction of the world has the angle turn + side * angle in the frame of a row [n]
    heading        of the waypoint in the world [n] (rad)
    acts           the row has an action, and the row after it is what followed [n]
    reach_m        farthest that a winch comes in a control step
    """

    wide: Wide
    com_velocity: Floats
    turn: Floats
    side: Floats
    heading: Floats
    acts: Flags
    reach_m: float

    def direction(self, rows: Ints, heading: Floats) -> Floats:
        """A heading [m] in the frames of rows [m, 2]."""
        angle = self.turn[rows] + self.side[rows] * heading
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def take(self, rows: Ints, direction: Floats | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """[s; e] [m, ni] and rest lengths [m, nu] in rows [m]; as if the waypoint lay in a direction [m, 2], if any.

        e is zero in rows without an action.
        """
        inputs, rest_lengths = self.wide.take(rows)
        moved = np.clip((inputs[:, MOVED] - rest_lengths) / self.reach_m, -1, 1)
        inputs[:, MOVED] = np.where(self.acts[rows, None], moved, np.float32(0))
        if direction is not None:
            inputs[:, schema.TARGET] = direction
        return torch.from_numpy(inputs), torch.from_numpy(rest_lengths)

    def filed(self, held_rows: int = HELD_ROWS) -> Transitions:
        """The same with its wide part in a file, if it is in memory and has more rows than may stay there."""
        if len(self.acts) > held_rows and isinstance(self.wide, Held):
            return replace(self, wide=Filed(self.wide))
        return self


def joined(iterations: Sequence[Transitions]) -> Transitions:
    """Transitions of several iterations, one after the other."""
    lengths = np.array([len(each.acts) for each in iterations])
    firsts = (np.cumsum(lengths) - lengths).tolist()
    narrow = {
        name: np.concatenate([getattr(each, name) for each in iterations])
        for name in ("com_velocity", "turn", "side", "heading", "acts")
    }
    wide = Several([(first, each.wide) for first, each in zip(firsts, iterations, strict=True)])
    return Transitions(wide, **narrow, reach_m=iterations[0].reach_m)


@dataclass(frozen=True)
class Motion:
    """Reads the columns of one episode that only the action value needs.

    mirrored   the symmetry element mirrors the world [elements]
    """

    mirrored: Flags

    def read(self, frames: pa.Table) -> Columns:
        """Node velocities, rest lengths, and how the frames of the rows lie in the world."""
        target, turn = vectors(frames, "target_direction"), vectors(frames, "frame_yaw_rad")
        mirrored = self.mirrored[schema.array(frames, "element").astype(np.int64)]
        side = np.where(mirrored, np.float32(-1), np.float32(1))
        return {
            "node_velocities": vectors(frames, "node_velocities"),
            "rest_lengths": vectors(frames, "rest_lengths"),
            "turn": turn,
            "side": side,
            "heading": side * (np.arctan2(target[:, 1], target[:, 0]) - turn),
        }


def with_reach(rows: Rows, rest_lengths: Floats, reach_m: float) -> Rows:
    """Rows whose state has the rest lengths [n, nu] (m) as well, and whose models regress on what winches reach."""
    return replace(rows, state=np.hstack([rows.state, rest_lengths]), reach_m=reach_m)


def of_columns(columns: Columns, reach_m: float) -> Transitions:
    """Transitions of the columns that `Motion` and a reading of rows have found."""
    velocity = np.ascontiguousarray(columns["state"][:, :VELOCITY_N])
    parts = columns["observation"], velocity, columns["node_velocities"], columns["action"]
    narrow = {name: columns[name] for name in ("turn", "side", "heading", "acts")}
    return Transitions(Held(parts, columns["rest_lengths"]), velocity, **narrow, reach_m=reach_m)
