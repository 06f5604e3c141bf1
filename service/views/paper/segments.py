"""Trajectories cut into segments, each with its class (paper Sec. III-A; Algorithm 2, lines 3 to 5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from t6gps.learner.algorithm.segments import cut
from t6gps.service.views.paper.material import Material
from t6gps.service.views.paper.stretch import Stretch, track, world_nodes
from t6gps.service.views.run_figures import (
    CLASS_COLOURS,
    DARK,
    GREY,
    STYLE,
    ClassName,
    canvas,
    class_label,
    numbers,
)
from t6gps.workers.robot.topology import DELTA, FACES, LAMBDA

MARGIN_M = 0.7
STEPS_PER_S = 10.0


class Segment(NamedTuple):
    """Control steps start .. stop - 1 of an episode on one support triangle.

    row     of `start` among the frames
    key     kind, canonical entry and exit edge; None for an edge where it is partial
    cut     the robot stays longer: the first part of a long stay
    """

    episode: int
    row: int
    start: int
    stop: int
    face: int
    key: ClassName
    cut: bool


def segments(frames: pa.Table, longest_steps: int) -> list[Segment]:
    """Segments of whole episodes, in the order of `frames`, which are sorted by episode and step.

    Every control step lies in one of them; the last row of an episode, which has no action, in none.
    """
    episode, step, face, kind = (numbers(frames, name).astype(int) for name in ("episode_id", "step", "face", "kind"))
    new = np.diff(episode, prepend=episode[:1] - 1) != 0
    pieces = cut(new | (np.diff(face, prepend=-1) != 0), np.append(~new[1:], False), longest_steps)
    entry, exit_ = frames["entry_edge"].to_pylist(), frames["exit_edge"].to_pylist()
    return [
        Segment(
            episode=int(episode[start]),
            row=start,
            start=int(step[start]),
            stop=int(step[stop - 1]) + 1,
            face=int(face[start]),
            key=(int(kind[start]), entry[start] if enters else None, exit_[stop - 1] if leaves else None),
            cut=not leaves,
        )
        for start, stop, enters, leaves in zip(
            pieces.start.tolist(), pieces.stop.tolist(), pieces.enters, pieces.leaves, strict=True
        )
    ]


def lane(segment: Segment) -> ClassName:
    """The class of a complete segment; of others, which are partial or cut, the kind alone."""
    return segment.key if segment.key in CLASS_COLOURS and not segment.cut else (segment.key[0], None, None)


LANES = [key for kind in (DELTA, LAMBDA) for key in [*CLASS_COLOURS, (kind, None, None)] if key[0] == kind]
"""Classes in the order in which they are shown."""
FIRST_LAMBDA = [kind for kind, _, _ in LANES].index(LAMBDA)


def trajectory(material: Material, shown: Stretch) -> Figure:
    """A stretch of the shown episode: from above with its triangles, and over the time with its classes."""
    frames = material.shown.frames
    found = [
        segment
        for segment in segments(frames, material.config.learner.longest_segment_steps)
        if segment.stop > shown.first and segment.start < shown.last
    ]
    with rc_context(STYLE):
        figure = canvas(9.4, 4.6)
        plan, time = figure.subplots(1, 2, width_ratios=[1, 1.25])
        _plan(plan, frames, found)
        _lanes(time, found)
        time.set_xlim(shown.first / STEPS_PER_S, shown.last / STEPS_PER_S)
        figure.suptitle(material.title, fontsize=11, fontweight="bold", x=0.01, ha="left")
    return figure


def _plan(axes: Axes, frames: pa.Table, found: list[Segment]) -> None:
    """The path of the centre of mass in the colours of its classes, over the triangle that each segment enters."""
    path, nodes = track(frames), world_nodes(frames)
    for number, segment in enumerate(found):
        piece, colour = path[segment.row : segment.row + segment.stop - segment.start + 1], _colour(segment)
        corners = nodes[segment.row, FACES[segment.face], :2]
        fill = "#E4EEF5" if segment.key[0] == DELTA else "none"
        axes.add_patch(Polygon(corners, facecolor=fill, edgecolor="#B8B8B8", linewidth=0.7, alpha=0.8, zorder=1))
        axes.plot(*piece.T, color=colour, linewidth=2.6, zorder=3)
        axes.plot(*piece[0], color=DARK, marker="|" if segment.cut else "o", markersize=3, zorder=4)
        axes.annotate(str(number + 1), piece[0], (5, 4), textcoords="offset points", fontsize=8, zorder=5)
    whole = path[found[0].row : found[-1].row + found[-1].stop - found[-1].start + 1]
    low, high = whole.min(axis=0) - MARGIN_M, whole.max(axis=0) + MARGIN_M
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_title("From above; Delta filled, Lambda empty", fontsize=9.5)


def _lanes(axes: Axes, found: list[Segment]) -> None:
    """A bar for each segment in the row of its class, with its number."""
    for number, segment in enumerate(found):
        row, start_s = LANES.index(lane(segment)), segment.start / STEPS_PER_S
        hatch = "////" if segment.cut else None
        length_s = (segment.stop - segment.start) / STEPS_PER_S
        axes.barh(row, length_s, 0.7, start_s, color=_colour(segment), hatch=hatch, edgecolor="white", linewidth=0.8)
        axes.annotate(str(number + 1), (start_s, row - 0.38), ha="left", va="bottom", fontsize=8)
    axes.axhline(FIRST_LAMBDA - 0.5, color=GREY, linewidth=0.8)
    axes.set_yticks(range(len(LANES)), [class_label(key) for key in LANES], fontsize=9)
    axes.set_ylim(len(LANES) - 0.4, -0.7)
    axes.set(xlabel="time (s)")
    axes.set_title("Classes over the time: edges of entry → exit", fontsize=9.5)


def _colour(segment: Segment) -> str:
    return CLASS_COLOURS.get(lane(segment), GREY)
