"""Phases of the learner in their order (paper Algorithm 2: lines 3 to 5, 4 to 6, 8 to 11, and 13)."""

from __future__ import annotations

from typing import NamedTuple


class Phase(NamedTuple):
    """One phase: the learner's method of that name, what a person reads, and the column of `iterations` in seconds."""

    name: str
    title: str
    duration_column: str


PHASES = (
    Phase("segment", "segmenting", "segmenting_s"),
    Phase("fit", "fitting", "fitting_s"),
    Phase("backward_pass", "backward pass", "backward_pass_s"),
    Phase("supervise", "supervised step", "supervised_s"),
)
