"""Rows of an episode on their way into a recording, over the time lines `step` and `time`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.workers.robot.recorded import numbers

Ints = NDArray[np.int64]


class Rows:
    """An episode's frames, and the recording that they go to."""

    def __init__(self, stream: rr.RecordingStream, frames: pa.Table) -> None:
        self.stream, self.frames = stream, frames
        self._step, self._time_s = np.asarray(schema.array(frames, "step")), numbers(frames, "time_s")

    def log(self, entity: str, always: rr.AsComponents) -> None:
        """Log what holds for the whole episode."""
        self.stream.log(entity, always, static=True)

    def send(self, entity: str, columns: Iterable[rr.ComponentColumn], chosen: Ints | None = None) -> None:
        """Send columns with an entry for each row, or for the `chosen` ones."""
        rows = slice(None) if chosen is None else chosen
        step = rr.TimeColumn("step", sequence=self._step[rows])
        time = rr.TimeColumn("time", duration=self._time_s[rows])
        self.stream.send_columns(entity, [step, time], columns)

    def send_changes(self, entity: str, states: Sequence[str]) -> None:
        """Send the states of the rows at which they change."""
        changes = np.flatnonzero([True, *(a != b for a, b in pairwise(states))])
        self.send(entity, rr.StateChange.columns(state=[states[row] for row in changes.tolist()]), changes)
