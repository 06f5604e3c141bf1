"""A stretch of an episode from above: the triangles under the centre of mass and their nodes (paper Sec. V-C)."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from t6gps.service.views.paper.stretch import Stretch, track, world_nodes
from t6gps.service.views.run_figures import BLUE, DARK, GREY, RED, STYLE, Array, canvas, contours, numbers
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.topology import DELTA, FACE_KINDS, FACES

Flags = NDArray[np.bool_]

MARGIN_M = 0.3
TOUCH_M = 0.01
"""A node whose surface is this close to the ground counts as on it."""
DELTA_FILL = (0, 0.45, 0.7, 0.16)


def footprints(frames: pa.Table, terrain: Terrain | None, shown: Stretch, node_radius_m: float, title: str) -> Figure:
    """Each support triangle in the middle of its stay, Delta filled and Lambda empty, and how its nodes slip meanwhile.

    Nodes on the ground are filled dots, others rings. Dark lines are the ways of nodes while they touch the ground.
    """
    path, nodes = track(frames), world_nodes(frames)
    chosen, found = path[shown.first : shown.last + 1], stays(frames, shown)
    corners = [nodes[(first + last) // 2, FACES[face], :2] for first, last, face in found]
    whole = np.concatenate([chosen, *corners])
    low, high = whole.min(axis=0) - MARGIN_M, whole.max(axis=0) + MARGIN_M
    with rc_context(STYLE):
        width, height = high - low
        figure = canvas(6.4, float(np.clip(1.6 + 4.6 * height / width, 3.0, 8.0)))
        axes = figure.subplots()
        if terrain is not None:
            contours(figure, axes, terrain, low, high, unused=1.5)
        for (first, last, face), triangle in zip(found, corners, strict=True):
            feet = nodes[first : last + 1, FACES[face]]
            touching = clearance(terrain, feet) < node_radius_m + TOUCH_M
            _triangle(axes, triangle, face)
            _feet(axes, triangle, touching[(last - first) // 2])
            _slip(axes, np.where(touching[..., None], feet[..., :2], np.nan))
        axes.plot(*path.T, color=GREY, linewidth=1.0)
        axes.plot(*chosen.T, color=RED, linewidth=2.0, zorder=4)
        axes.plot(*chosen[0], color=RED, marker="o", markersize=8, markeredgecolor="white", zorder=5)
        axes.annotate("start", chosen[0], xytext=(8, 8), textcoords="offset points", fontweight="bold", zorder=6)
        axes.set_title(title)
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        figure.legend(handles=_legend(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def stays(frames: pa.Table, shown: Stretch) -> list[tuple[int, int, int]]:
    """First and last row of each stay on a triangle within a stretch, and the triangle."""
    face = numbers(frames, "face").astype(int)[shown.first : shown.last + 1]
    starts = np.flatnonzero(np.diff(face, prepend=-1) != 0)
    ends = np.append(starts[1:], len(face)) - 1
    return [(shown.first + int(a), shown.first + int(b), int(face[a])) for a, b in zip(starts, ends, strict=True)]


def clearance(terrain: Terrain | None, places: Array) -> Array:
    """Distance of places [..., 3] from the plane of the ground below them (m)."""
    if terrain is None:
        return places[..., 2]
    x, y = places[..., 0], places[..., 1]
    distance: Array = (places[..., 2] - terrain.height(x, y)) * np.cos(np.radians(terrain.slope_deg(x, y)))
    return distance


def _triangle(axes: Axes, corners: Array, face: int) -> None:
    fill = DELTA_FILL if FACE_KINDS[face] == DELTA else "none"
    axes.add_patch(Polygon(corners, facecolor=fill, edgecolor=BLUE, linewidth=1.1, zorder=2))


def _feet(axes: Axes, corners: Array, touching: Flags) -> None:
    """Nodes [3, 2] of a triangle (m), and which of them touch the ground [3]."""
    fills = [DARK if touches else "white" for touches in touching]
    axes.scatter(corners[:, 0], corners[:, 1], s=13, c=fills, edgecolors=DARK, linewidths=0.8, zorder=3)


def _slip(axes: Axes, ways: Array) -> None:
    """Ways [t, 3, 2] of the nodes (m), NaN where they touch nothing."""
    for node in range(3):
        axes.plot(*ways[:, node].T, color=DARK, linewidth=1.6, zorder=3)


def _legend() -> list[Patch | Line2D]:
    dot = partial(Line2D, [], [], marker="o", markersize=4, markeredgecolor=DARK, linestyle="")
    return [
        Patch(facecolor=DELTA_FILL, edgecolor=BLUE, label="Delta, in mid-stay"),
        Patch(facecolor="white", edgecolor=BLUE, label="Lambda, in mid-stay"),
        Line2D([], [], color=RED, linewidth=2, label="centre of mass"),
        dot(color=DARK, label="node on the ground"),
        dot(color="white", label="node above it"),
        Line2D([], [], color=DARK, linewidth=1.6, label="its way while there: slip"),
    ]
