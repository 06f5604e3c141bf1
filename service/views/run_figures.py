"""Figures of a run, drawn from its tables alone: learning curves, a ground track, segment classes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from t6gps.storage import durable, schema, tables
from t6gps.storage.catalog import Run
from t6gps.workers.ground.ground import ground
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.symmetry import EDGE_NAMES, REFERENCE_FACE, REFERENCE_TRIANGLES_M
from t6gps.workers.robot.topology import DELTA, FACES, KIND_NAMES, LAMBDA
from t6gps.workers.settings import HALF_DIAMETER_M, RolloutSettings

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

Array = NDArray[np.float64]
ClassName = tuple[int, int | None, int | None]
"""Kind of the support triangle, canonical entry edge, canonical exit edge; None where a segment is partial."""

BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
"""Colours that stay apart for colour-blind readers (Okabe and Ito)."""
GREY, LIGHT, DARK = "#9A9A9A", "#C8C8C8", "#333333"
DOTS_PER_INCH = 160
STYLE: dict[RcKeyType, object] = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "savefig.dpi": DOTS_PER_INCH,
}
CLASS_COLOURS: dict[ClassName, str] = {
    (DELTA, 0, 0): PURPLE,
    (DELTA, 0, 1): BLUE,
    (DELTA, 0, 2): ORANGE,
    (LAMBDA, 1, 0): GREEN,
    (LAMBDA, 1, 1): PURPLE,
    (LAMBDA, 1, 2): ORANGE,
    (LAMBDA, 0, 0): RED,
    (LAMBDA, 0, 1): BLUE,
    (LAMBDA, 0, 2): SKY,
}
SPEED = "forward_speed_m_per_s"
OTHER_TRACKS_N, PATHS_PER_CLASS_N = 15, 30
TRACK_COLUMNS = ["episode_id", "step", "com_x_m", "com_y_m", "waypoint", "waypoint_x_m", "waypoint_y_m"]
SEGMENT_COLUMNS = ["episode_id", "step", "face", "kind", "entry_edge", "exit_edge", "nodes"]


def draw(run: Run, settings: RolloutSettings) -> list[Path]:
    """Draw all figures of what the run has committed in its world into its folder; none before the first iteration."""
    iterations, episodes = tables.read(run, "iterations"), tables.read(run, "episodes")
    if not iterations.num_rows:
        return []
    newest = pc.field("iteration") == pc.max(iterations["iteration"])
    episodes, classes = episodes.filter(newest), tables.read(run, "classes", filter=newest)
    frames = tables.read(run, "frames", list(dict.fromkeys(TRACK_COLUMNS + SEGMENT_COLUMNS)), newest)
    figures = {
        "learning": learning(iterations),
        "ground_track": ground_track(frames, episodes, settings),
        "segments": segments(frames, classes),
    }
    return [save(figure, run.figures / f"{name}.png") for name, figure in figures.items()]


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as its file's name says, PNG or SVG, whole or not at all; its folder is made when missing."""
    path.parent.mkdir(exist_ok=True)
    with rc_context({**STYLE, "svg.hashsalt": path.stem}):
        figure.savefig(
            durable.hidden(path), format=path.suffix[1:], metadata={"Date": None} if path.suffix == ".svg" else None
        )
    durable.publish(path)
    return path


def canvas(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout="constrained")


def numbers(table: pa.Table, name: str) -> Array:
    return np.asarray(schema.array(table, name), dtype=np.float64)


def learning(iterations: pa.Table) -> Figure:
    """Cost and forward speed of each iteration, with standard errors over its episodes, and how often it was stuck."""
    with rc_context(STYLE):
        figure = canvas(10, 3.2)
        panels = (
            ("Cost", "mean running cost (m²/s²)", "cost", "cost_standard_error", BLUE),
            ("Forward speed", "towards the waypoint (m/s)", SPEED, "forward_speed_standard_error", GREEN),
            ("Stuck", "share of time below 5 cm in 1 s (%)", "stuck_share_by_distance", None, RED),
        )
        for axes, (title, label, mean, error, colour) in zip(figure.subplots(1, 3), panels, strict=True):
            x, y = numbers(iterations, "iteration"), numbers(iterations, mean)
            if error is None:
                y = 100 * y
            else:
                spread = numbers(iterations, error)
                axes.fill_between(x, y - spread, y + spread, color=colour, alpha=0.2, linewidth=0)
            axes.plot(x, y, color=colour, marker="o", markersize=4.5)
            axes.set(title=title, xlabel="iteration", ylabel=label)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.set_ylim(bottom=0)
    return figure


def ground_track(frames: pa.Table, episodes: pa.Table, settings: RolloutSettings) -> Figure:
    """CoM track of the episode with the median forward speed, from above, with others on the same ground.

    Darker ground is lower, the grey circle has the size of the robot (paper Sec. V, the figure of the ground track).
    """
    rows = episodes.to_pylist()
    shown = rows[typical(episodes)]
    alike = [row["episode_id"] for row in rows if _ground(row) == _ground(shown) and row is not shown]
    path, goals = _track(frames, shown["episode_id"])
    corners = np.concatenate([path, path[:1] - 1.5, path[:1] + 1.5, goals - 1.5, goals + 1.5])
    low, high = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
    with rc_context(STYLE):
        width, height = high - low
        figure = canvas(5.6, float(np.clip(1.3 + 4.1 * height / width, 3.2, 7.0)))
        axes = figure.subplots()
        terrain = ground(settings.terrain, shown["terrain_seed"], shown["terrain_difficulty"])
        if terrain is not None:
            contours(figure, axes, terrain, low, high)
        for other in alike[:OTHER_TRACKS_N]:
            axes.plot(*_track(frames, other)[0].T, color=GREY, alpha=0.5, linewidth=0.9, zorder=2, label="others")
        axes.add_patch(Circle(tuple(path[0]), HALF_DIAMETER_M, facecolor=GREY, alpha=0.6, zorder=3))
        for number, goal in enumerate(goals):
            radius_m = settings.task.waypoint_radius_m
            disc = Circle(tuple(goal), radius_m, facecolor=(1, 1, 1, 0.6), edgecolor=DARK, zorder=3)
            axes.add_patch(disc)
            label = axes.annotate(str(number + 1), goal, ha="center", va="center", fontweight="bold", zorder=7)
            label.set_path_effects([Stroke(linewidth=2.5, foreground="white"), Normal()])
        halo = [Stroke(linewidth=4.5, foreground="white"), Normal()]
        axes.plot(*path.T, color=RED, linewidth=2.2, zorder=5, path_effects=halo, label="centre of mass")
        axes.plot(*path[-1], color=RED, marker="o", markeredgecolor="white", markersize=7, zorder=6)
        axes.set_title(f"Episode {shown['episode_id']}: {shown[SPEED]:+.2f} m/s forward")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        dot = partial(Line2D, [], [], marker="o", markersize=10, linestyle="", markeredgecolor=DARK)
        labels = {str(line.get_label()): line for line in axes.get_lines()}
        handles = {label: line for label, line in labels.items() if not label.startswith("_")}
        handles["start"] = dot(color=GREY, alpha=0.6)
        handles["waypoint"] = dot(color="white")
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=4)
    return figure


def typical(episodes: pa.Table) -> int:
    """Which row of `episodes` has the median forward speed; of an even number the slower of two."""
    order = np.argsort(numbers(episodes, SPEED), kind="stable")
    return int(order[(len(order) - 1) // 2])


def _ground(episode: Mapping[str, float]) -> tuple[int, float] | None:
    """What the ground of an episode depends on; None when it is flat."""
    difficulty = episode["terrain_difficulty"]
    return (int(episode["terrain_seed"]), difficulty) if difficulty > 0 else None


def _track(frames: pa.Table, episode_id: int) -> tuple[Array, Array]:
    """Path [T + 1, 2] and waypoints in their order [n, 2] (m) of one episode."""
    rows = frames.select(TRACK_COLUMNS).filter(pc.field("episode_id") == episode_id).sort_by("step")
    path = np.column_stack([numbers(rows, "com_x_m"), numbers(rows, "com_y_m")])
    goals = np.column_stack([numbers(rows, "waypoint_x_m"), numbers(rows, "waypoint_y_m")])
    _, first = np.unique(goals, axis=0, return_index=True)
    return path, goals[np.sort(first)]


def contours(figure: Figure, axes: Axes, terrain: Terrain, low: Array, high: Array, unused: float = 0.5) -> None:
    """Heights of the ground in a rectangle (m), darker where it is lower.

    unused   dark colours that are left out, as a share of the span of heights, so that what lies on them is seen
    """
    x, y = np.meshgrid(np.linspace(low[0], high[0], 200), np.linspace(low[1], high[1], 200))
    heights = terrain.height(x, y)
    if np.ptp(heights) == 0:  # level where the robot went, though perhaps not elsewhere
        return
    levels = np.linspace(heights.min(), heights.max(), 9)
    darkest = levels[0] - (levels[-1] - levels[0]) * unused
    filled = axes.contourf(x, y, heights, levels=levels, cmap="bone", vmin=darkest, zorder=0)
    figure.colorbar(filled, ax=axes, label="height of the ground (m)", shrink=0.85, format="%.1f")
    axes.grid(visible=False)


def segments(frames: pa.Table, classes: pa.Table) -> Figure:
    """Paths of the CoM over its support triangle in the canonical frame, by class (paper Fig. 4b), and class sizes."""
    kind, keys, paths = _paths(frames)
    with rc_context(STYLE):
        figure = canvas(11, 3.9)
        *maps, bars = figure.subplots(1, 3, width_ratios=[1, 1, 1.15])
        for axes, number in zip(maps, (DELTA, LAMBDA), strict=True):
            _triangle(axes, number)
            _lines(axes, [(key, path) for k, key, path in zip(kind, keys, paths, strict=True) if k == number])
        _class_sizes(bars, classes)
    return figure


def _paths(frames: pa.Table) -> tuple[list[int], list[ClassName], list[Array]]:
    """Kind, class and path [t, 2] (m) about the centre of its support triangle of each stay on one triangle."""
    rows = frames.select(SEGMENT_COLUMNS).sort_by([("episode_id", "ascending"), ("step", "ascending")])
    kind = numbers(rows, "kind").astype(int)
    nodes = numbers(rows, "nodes").reshape(-1, 12, 3)
    corners = FACES[REFERENCE_FACE][kind]
    com = -np.take_along_axis(nodes[..., :2], corners[..., None], axis=1).mean(axis=1)
    changes = np.diff(numbers(rows, "face")) != 0
    starts = np.flatnonzero(np.concatenate([[True], changes | (np.diff(numbers(rows, "episode_id")) != 0)]))
    stops = np.append(starts[1:], rows.num_rows)
    entry, exit_ = rows["entry_edge"].to_pylist(), rows["exit_edge"].to_pylist()
    keys = [(int(kind[a]), entry[a], exit_[b - 1]) for a, b in zip(starts, stops, strict=True)]
    return kind[starts].tolist(), keys, [com[a:b] for a, b in zip(starts, stops, strict=True)]


def _triangle(axes: Axes, kind: int) -> None:
    corners = REFERENCE_TRIANGLES_M[kind]
    axes.add_patch(Polygon(corners, facecolor="#F3F3F3", edgecolor="none", zorder=0))
    for edge, name in enumerate(EDGE_NAMES[kind]):
        ends = corners[[edge, (edge + 1) % 3]]
        dashed = kind == LAMBDA and edge == 0
        axes.plot(*ends.T, color=DARK, linewidth=1.6, linestyle="--" if dashed else "-", zorder=4)
        place = ends.mean(axis=0) * 1.28
        turn = 90 if edge == 0 else (-30 if edge == 1 else 30)
        axes.annotate(name, tuple(place), ha="center", va="center", rotation=turn, color=DARK, fontsize=9)
    axes.set(title=f"{KIND_NAMES[kind]} segments", xlabel="forward (m)", ylabel="left (m)", aspect="equal")
    axes.set(xlim=(-0.75, 0.95), ylim=(-0.85, 0.85))


def _lines(axes: Axes, segments_of_kind: list[tuple[ClassName, Array]]) -> None:
    """Complete segments in the colour of their class, up to PATHS_PER_CLASS_N of each."""
    drawn: dict[ClassName, list[Array]] = {}
    for key, path in segments_of_kind:
        if key in CLASS_COLOURS and len(path) > 1:
            drawn.setdefault(key, []).append(path)
    for key, paths in sorted(drawn.items()):
        chosen = paths[:: -(-len(paths) // PATHS_PER_CLASS_N)]
        axes.add_collection(LineCollection(chosen, colors=CLASS_COLOURS[key], linewidths=1.0, alpha=0.55, zorder=2))
        starts = np.array([path[0] for path in chosen])
        axes.scatter(starts[:, 0], starts[:, 1], s=9, color=CLASS_COLOURS[key], linewidths=0, alpha=0.8, zorder=3)


def _class_sizes(axes: Axes, classes: pa.Table) -> None:
    """Segments of each complete class, and of all partial and cut ones of a kind together."""
    sizes: dict[ClassName, int] = {}
    for row in classes.to_pylist():
        key = (row["kind"], row["entry_edge"], row["exit_edge"])
        key = key if key in CLASS_COLOURS and not row["truncated"] else (row["kind"], None, None)
        sizes[key] = sizes.get(key, 0) + row["segments"]
    keys = [key for kind in (DELTA, LAMBDA) for key in [*CLASS_COLOURS, (kind, None, None)] if key[0] == kind]
    keys = [key for key in keys if key in sizes]
    colours = [CLASS_COLOURS.get(key, LIGHT) for key in keys]
    bars = axes.barh(np.arange(len(keys)), [sizes[key] for key in keys], color=colours)
    axes.bar_label(bars, padding=3, fontsize=8, color=DARK)
    axes.set_yticks(np.arange(len(keys)), [class_label(key) for key in keys], fontsize=9)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.margins(x=0.12)
    axes.grid(visible=False, axis="y")
    axes.set(title="Segments per class", xlabel="segments in the last iteration")


def class_label(key: ClassName) -> str:
    """A class in words: kind of the triangle, and the edges through which it is entered and left."""
    kind, entry, exit_ = key
    if entry is None or exit_ is None:
        return f"{KIND_NAMES[kind]}  partial or cut"
    return f"{KIND_NAMES[kind]}  {EDGE_NAMES[kind][entry]} → {EDGE_NAMES[kind][exit_]}"
