"""Segments, crossings and what follows are those that SQL finds in the tables."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from tiny_run import Trained

from t6gps.service.api import asking
from t6gps.service.views.paper import segments as cutting
from t6gps.service.views.paper import topology
from t6gps.service.views.paper.material import FRAME_COLUMNS
from t6gps.service.views.paper.segments import LANES, Segment
from t6gps.storage import tables
from t6gps.storage.sql.query import query
from t6gps.workers.robot.topology import FACES_N, NEIGHBOR_FACE


@pytest.fixture(scope="module")
def frames(tiny: Trained) -> pa.Table:
    """All frames of training, in their order."""
    order = [("episode_id", "ascending"), ("step", "ascending")]
    return tables.read(tiny.run, "frames").sort_by(order).select(FRAME_COLUMNS)


@pytest.fixture(scope="module")
def found(tiny: Trained, frames: pa.Table) -> list[Segment]:
    return cutting.segments(frames, tiny.config.learner.longest_segment_steps)


def test_every_control_step_lies_in_one_segment_of_its_class(tiny: Trained, found: list[Segment]) -> None:
    sql = "SELECT episode_id, step, face, kind, entry_edge, exit_edge, truncated, class_step FROM segments"
    asked = query(asking.of_run(tiny.run, f"{sql} ORDER BY episode_id, step", {}))
    steps = [
        (segment.episode, step, segment.face, *segment.key, segment.cut, step - segment.start)
        for segment in found
        for step in range(segment.start, segment.stop)
    ]
    assert steps == [tuple(row.values()) for row in asked.to_pylist()]
    assert any(segment.cut for segment in found)


def test_a_segment_knows_its_row(found: list[Segment], frames: pa.Table) -> None:
    episodes, steps = frames["episode_id"].to_pylist(), frames["step"].to_pylist()
    assert [(episodes[each.row], steps[each.row]) for each in found] == [(each.episode, each.start) for each in found]


def test_two_episodes_on_the_same_triangle_are_two_segments() -> None:
    steps = [0, 1, 2, 0, 1, 2]
    same = {"face": [4] * 6, "kind": [0] * 6, "entry_edge": [None] * 6, "exit_edge": [None] * 6}
    found = cutting.segments(pa.table({"episode_id": [1, 1, 1, 2, 2, 2], "step": steps, **same}), 20)
    assert [(each.episode, each.row, each.start, each.stop) for each in found] == [(1, 0, 0, 2), (2, 3, 0, 2)]


def test_crossings_are_the_transitions_of_sql(tiny: Trained, frames: pa.Table) -> None:
    sql = "SELECT from_face, face, count(*) AS n FROM transitions GROUP BY ALL"
    asked = np.zeros((FACES_N, FACES_N), int)
    for row in query(asking.of_run(tiny.run, sql, {})).to_pylist():
        asked[row["from_face"], row["face"]] = row["n"]
    assert asked.sum() > 0
    np.testing.assert_array_equal(topology.crossings(frames), asked)


def test_every_segment_but_an_episodes_last_is_followed_by_one(found: list[Segment]) -> None:
    counts = topology.followers(found)
    assert counts.sum() == len(found) - len({segment.episode for segment in found})
    for row, lane in enumerate(LANES):
        leaving = [a for a, b in pairwise(found) if a.episode == b.episode and cutting.lane(a) == lane]
        assert counts[row].sum() == len(leaving)


def test_edges_between_neighbours_do_not_cross_in_the_plane() -> None:
    place = topology.places()
    edges = [(a, int(b)) for a in range(FACES_N) for b in NEIGHBOR_FACE[a] if a < b]
    assert len(edges) == 30

    def side(p: int, q: int, r: int) -> float:
        (x0, y0), (x1, y1), (x2, y2) = place[[p, q, r]]
        return float((x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0))

    for number, (a, b) in enumerate(edges):
        for c, d in edges[:number]:
            if len({a, b, c, d}) == 4:
                assert side(a, b, c) * side(a, b, d) > 0 or side(c, d, a) * side(c, d, b) > 0
