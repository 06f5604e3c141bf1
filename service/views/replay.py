"""What a page needs to show an episode: robot and ground in the world, and what happens when.

Numbers are rounded: lengths to 0.1 mm, tensions to 0.1 N. Lists of rows are flat, so that [T + 1, n] has n (T + 1)
numbers. The stored frames are exact, and have everything else.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from t6gps.service.config import Config
from t6gps.service.training import evaluation_records, origin
from t6gps.service.views.ground import Ground, around, rounded
from t6gps.storage import spool, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode
from t6gps.workers.ground.ground import ground
from t6gps.workers.pictures.motion import of_episode
from t6gps.workers.pictures.stays import stays, stuck
from t6gps.workers.pictures.viewer.world import World
from t6gps.workers.robot.recorded import numbers
from t6gps.workers.robot.symmetry import EDGE_NAMES, ELEMENTS_N
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, CABLES, FACES, FACES_N

Array = NDArray[np.float64]
BOUNDS = {"face": FACES_N, "element": ELEMENTS_N, "entry_edge": len(EDGE_NAMES[0]), "exit_edge": len(EDGE_NAMES[0])}
"""Columns that name parts of the robot, and how many there are."""
FARTHEST_M = 1e4
"""Of anything from the origin: no robot walks so far."""


@dataclass(frozen=True)
class Span:
    """Rows start .. stop - 1, and what they are: the kind of the triangle, 0 Delta or 1 Lambda, and the class."""

    start: int
    stop: int
    kind: int
    name: str


@dataclass(frozen=True)
class Mark:
    """From row `start` on the waypoint is at x_m, y_m."""

    start: int
    x_m: float
    y_m: float


@dataclass(frozen=True, kw_only=True)
class Replay:
    """An episode of a run, of training or of an evaluation, row by row.

    summary      its row of the table `episodes`
    time_s       [T + 1];   com_m   centre of mass [T + 1, 3];   nodes_m   ends of the bars [T + 1, 12, 3]
    tensions_n   of the cables [T + 1, 24]; from `brightest_n` on they are shown in the last colour
    face         number of the triangle under the centre of mass, of `faces` [T + 1]
    bars, cables, faces   numbers of nodes [6, 2], [24, 2], [20, 3]
    attached_share   of a bar's length that lies between the cables at its ends
    stuck        rows [start, stop) without a way
    ground_id    equal for episodes on the same ground; `ground` is None on the plane
    """

    run: str
    episode: int
    evaluation: int | None
    summary: dict[str, int | float | str | None]
    time_s: list[float]
    com_m: list[float]
    nodes_m: list[float]
    tensions_n: list[float]
    forward_speed_m_per_s: list[float]
    cost: list[float]
    face: list[int]
    segments: list[Span]
    stuck: list[tuple[int, int]]
    waypoints: list[Mark]
    bars: list[tuple[int, int]]
    cables: list[tuple[int, int]]
    faces: list[tuple[int, int, int]]
    brightest_n: float
    bar_radius_m: float
    attached_share: float
    waypoint_radius_m: float
    ground_id: str
    ground: Ground | None


def of_stored(run: Run, number: int, evaluation_id: int | None = None) -> Replay:
    """An episode that is committed. DataError for one that there is not, or that is damaged."""
    episode = tables.episode(run, number, evaluation_id)
    if evaluation_id is None:
        config = origin.configured(run)
    else:
        config = evaluation_records.world(run, tables.read(run, "evaluations"), evaluation_id)
    return replay(run.name, config, episode, evaluation_id)


def of_newest(run: Run) -> Replay:
    """The episode that came last: of the iteration that is being sampled, else the last one committed.

    DataError where there is none yet.
    """
    episode = spool.newest(run.spool)
    if episode is None:
        last = pc.max(tables.read(run, "episodes", ["episode_id"])["episode_id"]).as_py()
        if last is None:
            raise DataError(f"run {run.name} has no episode yet; wait for the first")
        return of_stored(run, last)
    return replay(run.name, origin.configured(run), episode, None)


def replay(name: str, config: Config, episode: Episode, evaluation_id: int | None) -> Replay:
    """An episode in the world of a configuration. DataError for one that nothing can be drawn of."""
    _check(name, episode)
    summary = episode.summary.to_pylist()[0]
    terrain = ground(config.terrain, summary["terrain_seed"], summary["terrain_difficulty"])
    world = World(config.robot, terrain, config.task.waypoint_radius_m)
    moved = of_episode(episode, config.robot)
    return Replay(
        run=name,
        episode=episode.episode_id,
        evaluation=evaluation_id,
        summary=summary,
        time_s=rounded(numbers(episode.frames, "time_s"), 4),
        com_m=rounded(moved.com, 4),
        nodes_m=rounded(moved.nodes, 4),
        tensions_n=rounded(moved.tensions, 1),
        forward_speed_m_per_s=rounded(numbers(episode.frames, "forward_speed_m_per_s"), 4),
        cost=rounded(numbers(episode.frames, "cost"), 4),
        face=numbers(episode.frames, "face").astype(int).tolist(),
        segments=[Span(*stay) for stay in stays(episode.frames)],
        stuck=_spans(stuck(moved.com)),
        waypoints=_marks(episode),
        bars=[(int(a), int(b)) for a, b in BARS],
        cables=[(int(a), int(b)) for a, b in CABLES],
        faces=[(int(a), int(b), int(c)) for a, b, c in FACES],
        brightest_n=world.brightest_n,
        bar_radius_m=config.robot.bar_radius_m,
        attached_share=config.robot.attachment_span_m / BAR_LENGTH_M,
        waypoint_radius_m=world.waypoint_radius_m,
        ground_id="plane" if terrain is None else hashlib.sha256(terrain.heights.tobytes()).hexdigest()[:16],
        ground=None if terrain is None else around(terrain, moved.com[:, :2]),
    )


def _check(name: str, episode: Episode) -> None:
    """DataError for numbers that no robot has; schemas bound neither faces nor places."""
    frames = episode.frames
    named = all(
        all(0 <= value < most for value in frames[column].unique().drop_null().to_pylist())
        for column, most in BOUNDS.items()
    )
    near = np.abs(numbers(frames, "bar_positions")).max() < FARTHEST_M
    sane = all(np.abs(numbers(frames, column)).max() < 1e9 for column in ("cost", "time_s", "rest_lengths"))
    if not (named and near and sane):
        raise DataError(
            f"episode {episode.episode_id} of run {name} has numbers that no robot has; see t6gps verify {name}"
        )


def _spans(held: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where a condition holds, as [start, stop)."""
    turns = np.flatnonzero(np.diff(np.r_[False, held, False])).tolist()
    return list(zip(turns[::2], turns[1::2], strict=True))


def _marks(episode: Episode) -> list[Mark]:
    x, y = (numbers(episode.frames, f"waypoint_{axis}_m") for axis in "xy")
    changes = np.flatnonzero(np.r_[True, (np.diff(x) != 0) | (np.diff(y) != 0)]).tolist()
    return [Mark(row, round(float(x[row]), 4), round(float(y[row]), 4)) for row in changes]
