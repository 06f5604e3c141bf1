"""How a trained robot crosses its ground: tracks, footprints, climbs and directions, from stored episodes by query.

The episodes are those of the last third of the iterations, with exploration noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from t6gps.service.studies.conduct import Finished
from t6gps.service.views import run_figures
from t6gps.service.views.paper.footprints import footprints as drawn_footprints
from t6gps.service.views.paper.snapshots import snapshots
from t6gps.service.views.paper.stretch import Stretch, smooth
from t6gps.service.views.run_figures import (
    BLUE,
    DARK,
    GREY,
    ORANGE,
    RED,
    STYLE,
    canvas,
    numbers,
)
from t6gps.storage import tables
from t6gps.storage.sql.query import Question, query
from t6gps.workers.ground.ground import ground
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures.scene import Sizes
from t6gps.workers.robot.symmetry import EDGE_NAMES
from t6gps.workers.robot.topology import BAR_LENGTH_M, DELTA, KIND_NAMES, LAMBDA

Array = NDArray[np.float64]

LATE = "3 * (iteration + 1) > 2 * (SELECT max(iteration) + 1 FROM frames)"
"""Rows of the last third of the iterations."""

LARGEST_CLIMBS = f"""
    WITH smooth AS (
        SELECT episode_id, step, avg(com_z_m) OVER (
            PARTITION BY episode_id ORDER BY step ROWS BETWEEN 5 PRECEDING AND 5 FOLLOWING) AS height_m
        FROM frames WHERE {LATE}),
    climbed AS (
        SELECT episode_id, step, height_m - min(height_m) OVER (PARTITION BY episode_id ORDER BY step) AS gain_m
        FROM smooth)
    SELECT episode_id, max(gain_m) AS gain_m, arg_max(step, gain_m) AS top_step
    FROM climbed GROUP BY episode_id ORDER BY gain_m DESC, episode_id
"""
"""The largest height gain of the centre of mass in each episode, over running means of 1.1 s, so that neither the
pumping of the shape nor a bump of a single step counts."""

TRANSITIONS = f"""
    SELECT kind, entry_edge, exit_edge, count(*) AS transitions FROM frames
    WHERE exit_edge IS NOT NULL AND entry_edge IS NOT NULL AND {LATE}
    GROUP BY ALL ORDER BY ALL
"""
HIGH_CLIMB_M = 2 / 3 * BAR_LENGTH_M
"""Net height gain that the paper shows (Sec. V-C): two thirds of a bar."""
MOVING_M_PER_S = 0.2
BINS_N = 12
GRADE_DEG, GRADES_DEG = 5.0, 35.0
"""Width of a bin of slopes, and the steepest of them."""
FEWEST_STEPS_N = 100
"""A bin with fewer rows has no mean worth drawing."""
SLOPE_POINTS_N = 7


@dataclass(frozen=True)
class Climb:
    """The largest climb of a study: its run, its episode's frames by step and ground, and where it lies in them."""

    outcome: Finished
    frames: pa.Table
    terrain: Terrain | None
    episode_id: int
    shown: Stretch


def ground_track(finished: Sequence[Finished]) -> Figure:
    """Ground track of the typical episode of the first run's last iteration (paper Sec. V-C)."""
    run = finished[0].run
    newest = pc.field("iteration") == tables.committed_iterations(run) - 1
    frames = tables.read(run, "frames", run_figures.TRACK_COLUMNS, newest)
    episodes = tables.read(run, "episodes", filter=newest)
    return run_figures.ground_track(frames, episodes, finished[0].trial.config)


def largest_climb(finished: Sequence[Finished]) -> Climb:
    """The largest height gain among the stored episodes of all runs."""
    tops = [
        (query(Question([outcome.run], LARGEST_CLIMBS)).slice(0, 1).to_pylist()[0], outcome) for outcome in finished
    ]
    best, outcome = max(tops, key=lambda item: item[0]["gain_m"])
    frames = tables.episode(outcome.run, best["episode_id"]).frames.sort_by("step")
    row = tables.read(outcome.run, "episodes", filter=pc.field("episode_id") == best["episode_id"]).to_pylist()[0]
    terrain = ground(outcome.trial.config.terrain, row["terrain_seed"], row["terrain_difficulty"])
    top = best["top_step"]
    bottom = int(smooth(numbers(frames, "com_z_m"))[: top + 1].argmin())
    return Climb(outcome, frames, terrain, best["episode_id"], Stretch(bottom, top, best["gain_m"]))


def footprints(finished: Sequence[Finished]) -> Figure:
    """The largest climb from above: the triangles under the centre of mass and their nodes (paper Sec. V-C)."""
    climb_ = largest_climb(finished)
    seconds = (climb_.shown.last - climb_.shown.first) / 10
    title = f"{climb_.outcome.run.name}, episode {climb_.episode_id}: {climb_.shown.gain_m:.2f} m up in {seconds:.1f} s"
    radius_m = climb_.outcome.trial.config.robot.bar_radius_m
    return drawn_footprints(climb_.frames, climb_.terrain, climb_.shown, radius_m, title)


def climb(finished: Sequence[Finished]) -> Figure:
    """Snapshots of the largest climb by the project's own renderer, and the height along it (paper Sec. V-C)."""
    climb_ = largest_climb(finished)
    config = climb_.outcome.trial.config
    sizes = Sizes(config.robot.bar_radius_m, config.task.waypoint_radius_m, config.robot.attachment_span_m)
    title = f"{climb_.outcome.run.name}, episode {climb_.episode_id}, {climb_.shown.gain_m:.2f} m up"
    return snapshots(climb_.frames, climb_.terrain, climb_.shown, sizes, title)


def climbs(finished: Sequence[Finished]) -> Figure:
    """How large the largest climbs of the episodes are, and the share that reaches two thirds of a bar."""
    gains = np.concatenate([numbers(query(Question([outcome.run], LARGEST_CLIMBS)), "gain_m") for outcome in finished])
    with rc_context(STYLE):
        figure = canvas(7, 3.6)
        axes = figure.subplots()
        axes.hist(gains, 30, color=BLUE)
        axes.axvline(HIGH_CLIMB_M, color=RED, label=f"2/3 of a bar, {HIGH_CLIMB_M:.2f} m")
        share = (gains >= HIGH_CLIMB_M).mean()
        axes.set_title(
            f"{share:.1%} of {len(gains)} episodes climb 2/3 of a bar; the largest gain is {gains.max():.2f} m"
        )
        axes.set(xlabel="largest height gain of the centre of mass in an episode (m)", ylabel="episodes")
        axes.legend()
    return figure


def any_axis(finished: Sequence[Finished]) -> Figure:
    """Directions of motion relative to the bottom triangle and the edges crossed, in the runs of the first arm.

    A triangle's own symmetry is divided out: turns by 120 deg of a Delta, the mirror of a Lambda. Evenness is the
    entropy over that of equal shares, 1 for motion along any axis and 0 along a single one.
    """
    finished = [outcome for outcome in finished if outcome.trial.arm == finished[0].trial.arm]
    sql = f"SELECT kind, com_velocity[1] AS vx, com_velocity[2] AS vy FROM frames WHERE {LATE}"
    rows = pa.concat_tables([query(Question([outcome.run], sql)) for outcome in finished])
    velocity = np.column_stack([numbers(rows, "vx"), numbers(rows, "vy")])
    kind, moving = numbers(rows, "kind"), np.hypot(*velocity.T) > MOVING_M_PER_S
    angle_deg = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))
    crossings = pa.concat_tables([query(Question([outcome.run], TRANSITIONS)) for outcome in finished]).group_by(
        ["kind", "entry_edge", "exit_edge"]
    )
    counts = crossings.aggregate([("transitions", "sum")]).sort_by([(name, "ascending") for name in ORDER])
    with rc_context(STYLE):
        figure = canvas(12, 3.8)
        delta, lambda_, edges = figure.subplots(1, 3)
        _directions(delta, KIND_NAMES[DELTA], angle_deg[moving & (kind == DELTA)] % 120, 120)
        _directions(lambda_, KIND_NAMES[LAMBDA], np.abs(angle_deg[moving & (kind == LAMBDA)]), 180)
        delta.set_xlabel("direction relative to the triangle, modulo 120° (°)")
        lambda_.set_xlabel("direction from the axis of the triangle (°)")
        _crossings(edges, counts)
    return figure


def grades(finished: Sequence[Finished]) -> Figure:
    """Speed towards the waypoint by how steeply the ground rises on the way there, in the runs of the first arm.

    The rise is that of the plane which fits the ground within half a bar of the centre of mass best.
    """
    finished = [outcome for outcome in finished if outcome.trial.arm == finished[0].trial.arm]
    angle_deg, speed = (np.concatenate(part) for part in zip(*map(_rises, finished), strict=True))
    bounds = np.arange(-GRADES_DEG, GRADES_DEG + 1, GRADE_DEG)
    inside, middles = (np.abs(angle_deg) < GRADES_DEG), (bounds[1:] + bounds[:-1]) / 2
    counts, _ = np.histogram(angle_deg[inside], bounds)
    sums, _ = np.histogram(angle_deg[inside], bounds, weights=speed[inside])
    shown = counts >= FEWEST_STEPS_N
    with rc_context(STYLE):
        figure = canvas(7, 3.8)
        axes = figure.subplots()
        axes.bar(middles, 100 * counts / len(speed), width=GRADE_DEG, color=GREY, alpha=0.5, edgecolor="white")
        axes.set(xlabel="rise of the ground towards the waypoint (°)", ylabel="share of the time (%)")
        axes.grid(visible=False)
        speeds = axes.twinx()
        speeds.plot(middles[shown], sums[shown] / counts[shown], color=BLUE, marker="o", markersize=4.5)
        speeds.set_ylabel("towards the waypoint (m/s)", color=BLUE)
        speeds.set_ylim(bottom=min(0.0, speeds.get_ylim()[0]))
        uphill = angle_deg > GRADE_DEG
        if uphill.any() and not uphill.all():
            share, up, other = uphill.mean(), speed[uphill].mean(), speed[~uphill].mean()
            axes.set_title(
                f"{share:.0%} of the time uphill by {GRADE_DEG:.0f}° or more: {up:.2f} m/s; else {other:.2f}"
            )
    return figure


def _rises(outcome: Finished) -> tuple[Array, Array]:
    """Rise of the ground towards the waypoint (deg) and speed towards it (m/s), row by row."""
    columns = "episode_id, com_x_m, com_y_m, waypoint_x_m, waypoint_y_m, forward_speed_m_per_s"
    rows = query(Question([outcome.run], f"SELECT {columns} FROM frames WHERE {LATE} ORDER BY episode_id, step"))
    place = np.column_stack([numbers(rows, "com_x_m"), numbers(rows, "com_y_m")])
    ahead = np.column_stack([numbers(rows, "waypoint_x_m"), numbers(rows, "waypoint_y_m")]) - place
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    episode, rises = numbers(rows, "episode_id"), np.zeros(len(place))
    for row in tables.read(outcome.run, "episodes", filter=pc.field("episode_id").isin(np.unique(episode))).to_pylist():
        terrain = ground(outcome.trial.config.terrain, row["terrain_seed"], row["terrain_difficulty"])
        chosen = episode == row["episode_id"]
        if terrain is not None:
            rises[chosen] = (slope(terrain, place[chosen]) * ahead[chosen]).sum(axis=1)
    return np.degrees(np.arctan(rises)), numbers(rows, "forward_speed_m_per_s")


def slope(terrain: Terrain, place: Array) -> Array:
    """Gradient [n, 2] of the plane that fits the ground within half a bar of each place [n, 2] (m) best, by x and y."""
    steps = np.linspace(-BAR_LENGTH_M / 2, BAR_LENGTH_M / 2, SLOPE_POINTS_N)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    heights = terrain.height(*np.moveaxis(place[:, None] + around, 2, 0))
    gradient: Array = heights @ around / (around[:, 0] @ around[:, 0])
    return gradient


ORDER = ("kind", "entry_edge", "exit_edge")


def evenness(shares: Array) -> float:
    """Entropy of shares that sum to one over its largest value [0, 1]."""
    present = shares[shares > 0]
    return float(-(present * np.log(present)).sum() / np.log(len(shares)))


def _directions(axes: Axes, name: str, angle_deg: Array, range_deg: float) -> None:
    counts, bounds = np.histogram(angle_deg, BINS_N, (0, range_deg))
    shares = counts / max(counts.sum(), 1)
    axes.bar(bounds[:-1], 100 * shares, width=range_deg / BINS_N, align="edge", color=BLUE, edgecolor="white")
    axes.axhline(100 / BINS_N, color=DARK, linewidth=0.8, linestyle="--")
    axes.set(title=f"Motion on a {name}: evenness {evenness(shares):.3f}", ylabel="share of the time (%)")


def _crossings(axes: Axes, counts: pa.Table) -> None:
    rows = counts.to_pylist()
    total = {kind: sum(row["transitions_sum"] for row in rows if row["kind"] == kind) for kind in (DELTA, LAMBDA)}
    shares = [100 * row["transitions_sum"] / total[row["kind"]] for row in rows]
    names = [
        f"{KIND_NAMES[k]} {EDGE_NAMES[k][a]} → {EDGE_NAMES[k][b]}"
        for k, a, b in (tuple(row[n] for n in ORDER) for row in rows)
    ]
    bars = axes.barh(range(len(rows)), shares, color=[(BLUE, ORANGE)[row["kind"]] for row in rows])
    axes.bar_label(bars, fmt="%.0f", padding=3, fontsize=8)
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(title="Stays by the edges crossed", xlabel="share of the stays on this kind (%)")
