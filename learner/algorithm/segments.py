"""Segmentation and classification of trajectories (paper Sec. III-A, IV-B; Algorithm 2, lines 3 to 5).

SegmentSamples (line 3) is `cut`, one episode at a time; FilterSegments (lines 4 and 5) is `classify` and `group`.

A segment is a run of rows [start, stop) on one support triangle. Its class is

    (kind, entry edge, exit edge, truncated)

in canonical edges, NONE where the trajectory began, ended, jumped, or was cut. A stay longer than the limit
is cut into pieces of the limit: every piece but the last is truncated, only the first has the entry, only the
last has the exit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from t6gps.learner.rows import NONE, Flags, Ints, Rows


class ClassKey(NamedTuple):
    """A segment class; NONE for a missing edge."""

    kind: int
    entry: int
    exit: int
    truncated: bool


class Pieces(NamedTuple):
    """Where segments lie [m]: first row and the row after the last; the first and the last piece of its stay.

    rows_n   rows that they were cut from
    """

    start: Ints
    stop: Ints
    enters: Flags
    leaves: Flags
    rows_n: int


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
    truncated: Flags
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


def cut(starts: Flags, acts: Flags, longest_steps: int) -> Pieces:
    """Segments of rows [n]: every row that acts lies in exactly one (paper Sec. III-A; IV-B, 3).

    `starts` says which rows are the first on their support triangle. What is cut from several episodes is what is cut
    from each, since every episode starts with such a row.
    """
    index = np.flatnonzero(acts)
    stay = np.cumsum(starts[index])
    first_of_stay = np.flatnonzero(np.diff(stay, prepend=0))
    age = np.arange(len(index)) - first_of_stay[stay - 1]
    begins = np.flatnonzero(age % longest_steps == 0)
    ends = np.append(begins[1:], len(index))[: len(begins)] - 1
    leaves = np.diff(stay, append=len(index) + 1)[ends] > 0
    return Pieces(index[begins], index[ends] + 1, age[begins] == 0, leaves, len(acts))


def join(episodes: Sequence[Pieces]) -> Pieces:
    """Segments of at least one episode, whose rows lie one under another."""
    rows_n = np.array([pieces.rows_n for pieces in episodes])
    segments_n = np.array([len(pieces.start) for pieces in episodes])
    above = np.repeat(np.cumsum(rows_n) - rows_n, segments_n)
    start, stop, enters, leaves, _ = zip(*episodes, strict=True)
    return Pieces(
        np.concatenate(start) + above,
        np.concatenate(stop) + above,
        np.concatenate(enters),
        np.concatenate(leaves),
        int(rows_n.sum()),
    )


def classify(rows: Rows, pieces: Pieces) -> Segments:
    """Segments with the parts of their classes: the edges of a stay belong to its first and its last piece."""
    start, stop = pieces.start, pieces.stop
    of_row = np.full(pieces.rows_n, NONE)
    of_row[rows.acts] = np.repeat(np.arange(len(start)), stop - start)
    return Segments(
        start=start,
        stop=stop,
        kind=rows.kind[start],
        entry=np.where(pieces.enters, rows.entry[start], NONE),
        exit=np.where(pieces.leaves, rows.exit[stop - 1], NONE),
        truncated=~pieces.leaves,
        of_row=of_row,
    )


def group(segments: Segments, smallest_class_segments: int) -> list[SegmentGroup]:
    """Groups in a fixed order; each segment lies in exactly one (FilterSegments of Algorithm 2, lines 4 and 5).

    Rare classes are pooled by exit as well as by kind: the exit fixes how labels and axes change with the
    crossing, so a pool over several exits would mix last steps that predict states in different frames.
    """
    columns = np.stack([segments.kind, segments.entry, segments.exit, segments.truncated])
    _, firsts, class_of = np.unique(columns, axis=1, return_index=True, return_inverse=True)
    groups, pools = [], dict[tuple[int, int], dict[ClassKey, Ints]]()
    for number, first in enumerate(firsts):
        key, members = segments.key(int(first)), np.flatnonzero(class_of.ravel() == number)
        if len(members) >= smallest_class_segments:
            groups.append(SegmentGroup(key, False, members, {key: members}))
        else:
            pools.setdefault((key.kind, key.exit), {})[key] = members
    for (kind, exit_), classes in sorted(pools.items()):
        members = np.sort(np.concatenate(list(classes.values())))
        groups.append(SegmentGroup(ClassKey(kind, NONE, exit_, False), True, members, classes))
    return groups
