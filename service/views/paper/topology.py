"""Which triangle and which class follows which (paper Sec. II-B, the figure of the topology; III-A).

The 20 support triangles lie in the plane as seen from one node of the robot, whose five triangles are the innermost
ones, in four rings of five. Lines are the 30 edges between neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray

from t6gps.service.views.paper.material import Material
from t6gps.service.views.paper.segments import FIRST_LAMBDA, LANES, Segment, lane, segments
from t6gps.service.views.run_figures import BLUE, DARK, GREY, LIGHT, STYLE, Array, canvas, class_label, numbers
from t6gps.workers.robot.topology import DELTA, FACE_KINDS, FACES, FACES_N, LAMBDA, NEIGHBOR_FACE, NODES_M

DELTA_FILL = "#9CC7E2"
NEAREST_NODE = 0
"""The node from which the robot is seen."""
Counts = NDArray[np.int64]


def crossings(frames: pa.Table) -> Counts:
    """How often the robot rolls from triangle a to triangle b [20, 20], in frames by episode and step."""
    episode, face = (numbers(frames, name).astype(int) for name in ("episode_id", "face"))
    changes = (np.diff(episode) == 0) & (np.diff(face) != 0)
    counts = np.zeros((FACES_N, FACES_N), dtype=np.int64)
    np.add.at(counts, (face[:-1][changes], face[1:][changes]), 1)
    return counts


def followers(found: Sequence[Segment]) -> Counts:
    """How often a segment of lane a is followed by one of lane b in its episode, by the order of LANES."""
    counts = np.zeros((len(LANES), len(LANES)), dtype=np.int64)
    for one, other in pairwise(found):
        if one.episode == other.episode:
            counts[LANES.index(lane(one)), LANES.index(lane(other))] += 1
    return counts


def places() -> Array:
    """Where the triangles lie in the plane [20, 2]: as far from the middle as they are turned from the nearest node."""
    middles = NODES_M[FACES].mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    axis = NODES_M[NEAREST_NODE] / np.linalg.norm(NODES_M[NEAREST_NODE])
    east = np.cross([0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0], axis)
    east /= np.linalg.norm(east)
    angle, turn = np.arccos(middles @ axis), np.arctan2(middles @ np.cross(axis, east), middles @ east)
    return angle[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])


def topology(material: Material) -> Figure:
    """Left: how often each edge between two triangles is crossed, each way. Right: which class follows which."""
    found = segments(material.frames, material.config.learner.longest_segment_steps)
    with rc_context(STYLE):
        figure = canvas(9.4, 4.9)
        left, right = figure.subplots(1, 2, width_ratios=[1, 1.1])
        _triangles(left, crossings(material.frames), numbers(material.frames, "face").astype(int))
        _matrix(right, followers(found))
    return figure


def _triangles(axes: Axes, counts: Counts, face: Counts) -> None:
    place, share = places(), np.bincount(face, minlength=FACES_N) / len(face)
    largest = int(counts.max())
    for a, b in zip(np.repeat(np.arange(FACES_N), 3), NEIGHBOR_FACE.ravel(), strict=True):
        if a < b:
            axes.plot(*place[[a, b]].T, color=LIGHT, linewidth=0.8, zorder=1)
        if counts[a, b]:
            way = FancyArrowPatch(
                tuple(place[a]), tuple(place[b]), connectionstyle="arc3,rad=0.13", arrowstyle="-|>", color=DARK,
                linewidth=0.3 + 2.7 * counts[a, b] / largest, mutation_scale=7, shrinkA=9, shrinkB=9, alpha=0.75,
            )  # fmt: skip
            axes.add_patch(way)
    for kind, marker, fill in ((DELTA, "^", DELTA_FILL), (LAMBDA, "s", "white")):
        of_kind = np.flatnonzero(kind == FACE_KINDS)
        sizes = 90 + 1800 * share[of_kind]
        x, y = place[of_kind].T
        axes.scatter(x, y, s=sizes, marker=marker, facecolor=fill, edgecolor=BLUE, linewidths=1.2, zorder=3)
    for number, middle in enumerate(place):
        axes.annotate(str(number), tuple(middle), ha="center", va="center", fontsize=6.5, color=DARK, zorder=4)
    neighbours = np.take_along_axis(counts, NEIGHBOR_FACE, axis=1).sum()
    jumps = int(counts.sum() - neighbours)
    axes.set_title(f"{neighbours:,} rolls over an edge, up to {largest:,} over one; {jumps:,} jumps", fontsize=9.5)
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.margins(0.08)
    dot = partial(Line2D, [], [], linestyle="", markersize=9, markeredgecolor=BLUE)
    handles = [
        dot(marker="^", color=DELTA_FILL, label="Delta"),
        dot(marker="s", color="white", label="Lambda"),
        Line2D([], [], color=DARK, linewidth=3, label="wider, larger: more often"),
    ]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.02), ncols=3, fontsize=8.5)


def _matrix(axes: Axes, counts: Counts) -> None:
    """Percent of the segments of each row's class that the column's class follows."""
    totals = counts.sum(axis=1, keepdims=True)
    percent = np.divide(100.0 * counts, totals, out=np.full(counts.shape, np.nan), where=totals > 0)
    axes.imshow(np.where(counts > 0, percent, np.nan), cmap="Blues", vmin=0, vmax=130, aspect="equal")
    for (row, column), value in np.ndenumerate(percent):
        if counts[row, column]:
            axes.annotate(f"{value:.0f}", (column, row), ha="center", va="center", fontsize=7.5, color=DARK)
    labels = [class_label(key) for key in LANES]
    axes.set_xticks(range(len(LANES)), labels, fontsize=7.5, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_yticks(
        range(len(LANES)), [f"{a} ({n:,})" for a, n in zip(labels, totals[:, 0], strict=True)], fontsize=7.5
    )
    axes.grid(visible=False)
    axes.axhline(FIRST_LAMBDA - 0.5, color=GREY, linewidth=0.8)
    axes.axvline(FIRST_LAMBDA - 0.5, color=GREY, linewidth=0.8)
    axes.set_xlabel("the class that follows", fontsize=9)
    axes.set_title("What follows (%); in brackets: segments", fontsize=9.5)
