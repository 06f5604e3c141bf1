"""Segmentation and classification of trajectories (paper Sec. III-A, IV-B; Algorithm 2, lines 3 to 5).

A segment is a run of rows [start, stop) on one support triangle. Its class is

    (kind, entry edge, exit edge, truncated)

in canonical edges, NONE where the trajectory began, ended, jumped, or was cut. A stay longer than the limit
is cut into pieces of the limit: every piece but the last is truncated, only the first has the entry, only the
last has the exit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import NONE, Rows

Ints = NDArray[np.int64]


class ClassKey(NamedTuple):
    """A segment class; NONE for a missing edge."""

    kind: int
    entry: int
    exit: int
    truncated: bool


@dataclass(frozen=True)
class Segments:
    """Segments of all episodes, m in all, over n rows.

    start, stop   first row and the row after the last [m]
    kind, entry, exit, truncated   of the class [m]
    of_row        segment of each row [n], NONE for rows without an action
    """

    start: Ints
    stop: Ints
    kind: Ints
    entry: Ints
    exit: Ints
    truncated: NDArray[np.bool_]
    of_row: Ints

    def key(self, segment: int) -> ClassKey:
        """Class of one segment."""
        kind, entry, exit_ = int(self.kind[segment]), int(self.entry[segment]), int(self.exit[segment])
        return ClassKey(kind, entry, exit_, bool(self.truncated[segment]))


@dataclass(frozen=True)
class SegmentGroup:
    """Segments that share models: one class, or the pool of all rare classes of one kind and exit.

    key        of the class; for a pool only its kind and exit carry meaning
    pooled     it is a pool
    segments   its segments, ascending
    classes    the classes in it and the segments of each
    """

    key: ClassKey
    pooled: bool
    segments: Ints
    classes: dict[ClassKey, Ints]


def cut(rows: Rows, longest_steps: int) -> Segments:
    """Segments of `rows`: every row with an action lies in exactly one (paper Sec. III-A; IV-B, 3)."""
    index = np.flatnonzero(rows.acts)
    stay = np.cumsum(rows.starts[index])
    first_of_stay = np.flatnonzero(np.diff(stay, prepend=0))
    age = np.arange(len(index)) - first_of_stay[stay - 1]
    begins = np.flatnonzero(age % longest_steps == 0)
    ends = np.append(begins[1:], len(index)) - 1
    last_of_stay = np.diff(stay, append=stay[-1] + 1)[ends] > 0
    of_row = np.full(len(rows.acts), NONE)
    of_row[index] = np.cumsum(age % longest_steps == 0) - 1
    return Segments(
        start=index[begins],
        stop=index[ends] + 1,
        kind=rows.kind[index[begins]],
        entry=np.where(age[begins] == 0, rows.entry[index[begins]], NONE),
        exit=np.where(last_of_stay, rows.exit[index[ends]], NONE),
        truncated=~last_of_stay,
        of_row=of_row,
    )


def group(segments: Segments, smallest_class_segments: int) -> list[SegmentGroup]:
    """Groups in a fixed order; each segment lies in exactly one (Algorithm 2, lines 4 and 5).

    Rare classes are pooled by exit as well as by kind: the exit fixes how labels and axes change with the
    crossing, so a pool over several exits would mix last steps that predict states in different frames.
    """
    columns = np.stack([segments.kind, segments.entry, segments.exit, segments.truncated])
    _, firsts, class_of = np.unique(columns, axis=1, return_index=True, return_inverse=True)
    own, pools = [], dict[tuple[int, int], dict[ClassKey, Ints]]()
    for number, first in enumerate(firsts):
        key, members = segments.key(int(first)), np.flatnonzero(class_of.ravel() == number)
        if len(members) >= smallest_class_segments:
            own.append(SegmentGroup(key, False, members, {key: members}))
        else:
            pools.setdefault((key.kind, key.exit), {})[key] = members
    for (kind, exit_), classes in sorted(pools.items()):
        members = np.sort(np.concatenate(list(classes.values())))
        own.append(SegmentGroup(ClassKey(kind, NONE, exit_, False), True, members, classes))
    return own
