"""Laws of what queries have beside tables: views are what plain numpy makes of the tables, and are described."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from tiny_run import Trained

from t6gps.service.api import asking
from t6gps.storage import tables
from t6gps.storage.sql import views
from t6gps.storage.sql.query import query
from t6gps.workers.episode import recording

EPISODE = [("iteration", "ascending"), ("episode_id", "ascending"), ("step", "ascending")]


@pytest.fixture(scope="module")
def found(tiny: Trained) -> dict[str, pa.Table]:
    """Every view of a run."""
    return {name: query(asking.of_run(tiny.run, f"SELECT * FROM {name}", {})) for name in views.VIEWS}


@pytest.mark.parametrize("name", views.VIEWS)
def test_a_view_has_the_columns_that_are_said_of_it(name: str, found: dict[str, pa.Table]) -> None:
    columns = views.VIEWS[name].columns
    assert [(field.name, field.type) for field in found[name].schema] == [(field.name, field.type) for field in columns]
    for field in columns:
        assert field.nullable or not found[name].column(field.name).null_count, field.name


def test_segments_are_those_that_the_learner_cut(tiny: Trained, found: dict[str, pa.Table]) -> None:
    steps = found["segments"]
    assert steps.num_rows == sum(tables.read(tiny.run, "episodes").column("steps").to_pylist())
    key = ["iteration", "kind", "entry_edge", "exit_edge", "truncated"]
    one_each = steps.group_by([*key, "episode_id", "segment"]).aggregate([("class_step", "count")])
    counted = {tuple(row[name] for name in key): row for row in classes_of(one_each, key)}
    stored = tables.read(tiny.run, "classes").to_pylist()
    assert {tuple(row[name] for name in key): (row["segments"], row["rows"]) for row in stored} == {
        name: (row["class_step_count_count"], row["class_step_count_sum"]) for name, row in counted.items()
    }


def classes_of(segments: pa.Table, key: list[str]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = (
        segments.group_by(key).aggregate([("class_step_count", "count"), ("class_step_count", "sum")]).to_pylist()
    )
    return rows


def test_steps_count_from_the_entry_of_the_triangle(found: dict[str, pa.Table]) -> None:
    steps = found["segments"].sort_by(EPISODE)
    face, step, since = (steps.column(name).to_numpy() for name in ("face", "step", "steps_since_entry"))
    enters = (step == 0) | (np.diff(face, prepend=face[0]) != 0)
    assert np.array_equal(since == 0, enters)
    assert (np.diff(since)[~enters[1:]] == 1).all()
    assert (steps.column("class_step").to_numpy() <= since).all()


def test_the_speed_of_a_class_is_the_mean_over_its_segments(found: dict[str, pa.Table]) -> None:
    speeds = found["speed_by_class"]
    total = (speeds.column("rows").to_numpy() * speeds.column("forward_speed_m_per_s").to_numpy()).sum()
    assert speeds.column("rows").to_numpy().sum() == found["segments"].num_rows
    assert total == pytest.approx(found["segments"].column("forward_speed_m_per_s").to_numpy().sum())


def test_transitions_are_those_that_the_worker_counted(tiny: Trained, found: dict[str, pa.Table]) -> None:
    counted = dict.fromkeys(tables.read(tiny.run, "episodes").column("episode_id").to_pylist(), 0)
    for row in found["transitions"].to_pylist():
        assert row["from_face"] != row["face"]
        assert row["stayed_steps"] >= 1
        counted[row["episode_id"]] += 1
    stored = tables.read(tiny.run, "episodes").to_pylist()
    assert counted == {row["episode_id"]: row["transitions"] for row in stored}


def test_the_learning_curve_counts_steps(tiny: Trained, found: dict[str, pa.Table]) -> None:
    curve = found["learning_curves"].sort_by("iteration")
    stored = tables.read(tiny.run, "iterations")
    assert curve.column("steps").to_pylist() == np.cumsum(stored.column("steps").to_numpy()).tolist()
    assert curve.column("cost").equals(stored.column("cost"))
    assert set(curve.column("seed").to_pylist()) == {0}


def test_stuck_is_what_the_worker_calls_stuck(tiny: Trained, found: dict[str, pa.Table]) -> None:
    assert views.STUCK_DISTANCE_M == recording.STUCK_DISTANCE_M
    assert views.STUCK_STEPS_N == recording.STUCK_STEPS
    rows = dict.fromkeys(tables.read(tiny.run, "episodes").column("episode_id").to_pylist(), 0)
    for row in found["stuck"].to_pylist():
        rows[row["episode_id"]] += row["steps"]
    for row in tables.read(tiny.run, "episodes").to_pylist():
        possible_n = row["steps"] + 1 - views.STUCK_STEPS_N
        assert rows[row["episode_id"]] / possible_n == pytest.approx(row["stuck_share_by_distance"])


def test_a_stay_is_as_long_as_it_can_be(found: dict[str, pa.Table]) -> None:
    stays = found["stuck"].sort_by(EPISODE).to_pylist()
    for one, other in pairwise(stays):
        if one["episode_id"] == other["episode_id"]:
            assert other["step"] > one["step"] + one["steps"]


def test_columns_describe_all_that_can_be_asked(tiny: Trained) -> None:
    described = query(asking.of_run(tiny.run, "SELECT * FROM columns", {})).to_pylist()
    sql = "SELECT table_name, column_name FROM duckdb_columns() WHERE NOT internal ORDER BY column_index"
    there = query(asking.of_run(tiny.run, sql, {})).to_pylist()
    assert {(row["table_name"], row["column_name"]) for row in described} == {
        (row["table_name"], row["column_name"]) for row in there
    }
    assert all(row["unit"] and row["meaning"] for row in described)


def test_a_table_that_is_named_by_a_text_is_read_too(tiny: Trained) -> None:
    sql = "SELECT count(*) AS n FROM query_table('epi' || 'sodes')"
    assert query(asking.of_run(tiny.run, sql, {})).to_pylist() == [{"n": 9}]
