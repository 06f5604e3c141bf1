"""What a query may ask beside the tables of runs: the table of runs, the table of columns, and views on both.

A view is SQL over tables and earlier views. Every one of them has the column `run` first, so that runs compare.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import pyarrow as pa

from t6gps.storage import fields, schema
from t6gps.storage.fields import scalar

STUCK_DISTANCE_M, STUCK_STEPS_N, STEPS_PER_S = 0.05, 10, 10.0
"""Stuck is what is less than that distance from its place of so many control steps before."""
DYNAMIC = ("query", "execute")
"""In the names of DuckDB's functions that take SQL, or a table's name, as text."""


@dataclass(frozen=True)
class View:
    """A view: its SELECT, its columns, and the tables that it reads."""

    sql: str
    columns: pa.Schema
    sources: tuple[str, ...]


RUNS = pa.schema(
    [
        schema.RUN,
        scalar("study", pa.string(), "", "study that trained it", nullable=True),
        scalar("arm", pa.string(), "", "what the study varies", nullable=True),
        scalar("seed", pa.int64(), "1", "root of its random streams", nullable=True),
        scalar("commit", pa.string(), "", "commit or version of t6gps that created it", nullable=True),
        scalar("made_at", pa.string(), "", "when it was created, UTC in ISO 8601", nullable=True),
        scalar("schema_version", pa.int32(), "1", "version of the tables that created it", nullable=True),
        scalar("learner_longest_segment_steps", pa.int64(), "1", "longer stays on a triangle are cut", nullable=True),
    ]
)
"""The columns of `runs` that views read. Who knows settings and evaluations adds theirs."""

COLUMNS = pa.schema(
    [
        scalar("table_name", pa.string(), "", "table or view"),
        scalar("column_name", pa.string(), "", "its column"),
        scalar("type", pa.string(), "", "Arrow's name of the type; after a list its length, where that is fixed"),
        scalar("unit", pa.string(), "", "unit; 1 for a number without one, text for text"),
        scalar("meaning", pa.string(), "", "what it says, and whether it may be null"),
    ]
)

_EPISODE = (
    schema.RUN,
    schema.EPISODES.field("iteration"),
    schema.EPISODES.field("episode_id"),
)
_FRAME = (*_EPISODE, schema.FRAMES.field("step"))
_KIND = schema.FRAMES.field("kind")
_CLASS = tuple(schema.CLASSES.field(name) for name in ("kind", "entry_edge", "exit_edge", "truncated"))
_CLASS_STEP = scalar("class_step", pa.int32(), "1", "control steps since the segment began, as `step` in `models`")
_PLACE = tuple(schema.FRAMES.field(name) for name in ("com_x_m", "com_y_m", "com_z_m", "ground_slope_deg"))


def _view(sources: str, columns: tuple[pa.Field, ...], sql: str) -> View:
    return View(sql, pa.schema(list(columns)), tuple(sources.split()))


VIEWS: Mapping[str, View] = MappingProxyType(
    {
        "segments": _view(
            "frames runs",
            (
                *_FRAME,
                scalar("segment", pa.int64(), "1", "segment of the episode, counted from 0"),
                *_CLASS,
                schema.FRAMES.field("face"),
                scalar("steps_since_entry", pa.int64(), "1", "control steps since the triangle was entered"),
                _CLASS_STEP,
                schema.FRAMES.field("cost"),
                schema.FRAMES.field("forward_speed_m_per_s"),
            ),
            """
            WITH marked AS (
                SELECT run, iteration, episode_id, step, face, kind, entry_edge, exit_edge, cost, forward_speed_m_per_s,
                    coalesce(face <> lag(face) OVER episode, true) AS starts, lead(step) OVER episode AS next_step
                FROM frames WINDOW episode AS (PARTITION BY run, iteration, episode_id ORDER BY step)),
            stays AS (
                SELECT *, sum(starts::INT) OVER (PARTITION BY run, iteration, episode_id ORDER BY step) AS stay
                FROM marked WHERE next_step IS NOT NULL),
            aged AS (
                SELECT *, row_number() OVER (
                    PARTITION BY run, iteration, episode_id, stay ORDER BY step) - 1 AS steps_since_entry
                FROM stays),
            cut AS (
                SELECT aged.*, coalesce(steps_since_entry // learner_longest_segment_steps, 0) AS piece
                FROM aged LEFT JOIN runs USING (run)),
            pieces AS (
                SELECT *, max(piece) OVER (PARTITION BY run, iteration, episode_id, stay) AS last_piece FROM cut)
            SELECT run, iteration, episode_id, step,
                dense_rank() OVER (PARTITION BY run, iteration, episode_id ORDER BY stay, piece) - 1 AS segment,
                kind,
                CASE WHEN piece = 0 THEN first_value(entry_edge) OVER piece_ END AS entry_edge,
                CASE WHEN piece = last_piece THEN last_value(exit_edge) OVER piece_ END AS exit_edge,
                piece < last_piece AS truncated,
                face, steps_since_entry, step - first_value(step) OVER piece_ AS class_step,
                cost, forward_speed_m_per_s
            FROM pieces WINDOW piece_ AS (
                PARTITION BY run, iteration, episode_id, stay, piece ORDER BY step
                ROWS BETWEEN UNBOUNDED PRECEDING AND UNBOUNDED FOLLOWING)
            """,
        ),
        "speed_by_class": _view(
            "segments",
            (
                schema.RUN,
                schema.EPISODES.field("iteration"),
                *_CLASS,
                _CLASS_STEP,
                scalar("rows", pa.int64(), "1", "control steps"),
                scalar("forward_speed_m_per_s", pa.float64(), "m/s", "mean over these rows"),
                scalar("forward_speed_deviation_m_per_s", pa.float64(), "m/s", "standard deviation over rows", True),
            ),
            """
            SELECT run, iteration, kind, entry_edge, exit_edge, truncated, class_step, count(*) AS rows,
                avg(forward_speed_m_per_s) AS forward_speed_m_per_s,
                stddev_samp(forward_speed_m_per_s) AS forward_speed_deviation_m_per_s
            FROM segments GROUP BY ALL
            """,
        ),
        "transitions": _view(
            "frames",
            (
                *_EPISODE,
                scalar("step", pa.int32(), "1", "first control step on the new triangle"),
                schema.FRAMES.field("time_s"),
                scalar("from_face", pa.int8(), "1", "support triangle that was left"),
                scalar("face", pa.int8(), "1", "support triangle that was entered"),
                scalar("from_kind", pa.int8(), "1", "kind of the triangle that was left: 0 Delta, 1 Lambda"),
                _KIND,
                scalar("exit_edge", pa.int8(), "1", "edge through which it was left; null for a jump", True),
                scalar("entry_edge", pa.int8(), "1", "edge through which the new one was entered", True),
                scalar("stayed_steps", pa.int32(), "1", "control steps on the triangle that was left"),
                *_PLACE,
            ),
            """
            WITH marked AS (
                SELECT *, lag(face) OVER episode AS from_face, lag(kind) OVER episode AS from_kind,
                    lag(exit_edge) OVER episode AS left_by
                FROM (SELECT run, iteration, episode_id, step, time_s, face, kind, entry_edge, exit_edge, com_x_m,
                    com_y_m, com_z_m, ground_slope_deg FROM frames)
                WINDOW episode AS (PARTITION BY run, iteration, episode_id ORDER BY step)),
            changes AS (
                SELECT * FROM marked WHERE from_face IS DISTINCT FROM face)
            SELECT * EXCLUDE (earlier) FROM (
                SELECT run, iteration, episode_id, step, time_s, from_face, face, from_kind, kind, left_by AS exit_edge,
                    entry_edge, step - lag(step) OVER episode AS stayed_steps, com_x_m, com_y_m, com_z_m,
                    ground_slope_deg, from_face IS NULL AS earlier
                FROM changes WINDOW episode AS (PARTITION BY run, iteration, episode_id ORDER BY step))
            WHERE NOT earlier
            """,
        ),
        "stuck": _view(
            "frames",
            (
                *_EPISODE,
                scalar("step", pa.int32(), "1", "first control step that is stuck"),
                schema.FRAMES.field("time_s"),
                scalar("steps", pa.int64(), "1", "control steps that are stuck, one after the other"),
                scalar("duration_s", pa.float64(), "s", "how long that is"),
                schema.FRAMES.field("face"),
                _KIND,
                *_PLACE,
                schema.FRAMES.field("waypoint_distance_m"),
            ),
            f"""
            WITH moved AS (
                SELECT run, iteration, episode_id, step, time_s, face, kind, com_x_m, com_y_m, com_z_m,
                    ground_slope_deg, waypoint_distance_m,
                    sqrt(pow(com_x_m - lag(com_x_m, {STUCK_STEPS_N}) OVER episode, 2)
                        + pow(com_y_m - lag(com_y_m, {STUCK_STEPS_N}) OVER episode, 2)
                        + pow(com_z_m - lag(com_z_m, {STUCK_STEPS_N}) OVER episode, 2)) AS distance_m
                FROM frames WINDOW episode AS (PARTITION BY run, iteration, episode_id ORDER BY step)),
            halts AS (
                SELECT *, step - row_number() OVER (PARTITION BY run, iteration, episode_id ORDER BY step) AS halt
                FROM moved WHERE distance_m < {STUCK_DISTANCE_M})
            SELECT run, iteration, episode_id, min(step) AS step, arg_min(time_s, step) AS time_s, count(*) AS steps,
                count(*) / {STEPS_PER_S}::DOUBLE AS duration_s, arg_min(face, step) AS face,
                arg_min(kind, step) AS kind, arg_min(com_x_m, step) AS com_x_m, arg_min(com_y_m, step) AS com_y_m,
                arg_min(com_z_m, step) AS com_z_m, arg_min_null(ground_slope_deg, step) AS ground_slope_deg,
                arg_min(waypoint_distance_m, step) AS waypoint_distance_m
            FROM halts GROUP BY run, iteration, episode_id, halt
            """,
        ),
        "learning_curves": _view(
            "iterations runs",
            (
                *(RUNS.field(name) for name in ("run", "study", "arm", "seed")),
                schema.ITERATIONS.field("iteration"),
                scalar("steps", pa.int64(), "1", "control steps sampled up to then, this iteration included"),
                *(
                    schema.ITERATIONS.field(name)
                    for name in (
                        "cost",
                        "cost_standard_error",
                        "forward_speed_m_per_s",
                        "forward_speed_standard_error",
                        "stuck_share_by_distance",
                        "waypoints_per_episode",
                        "policy_kl",
                    )
                ),
            ),
            """
            SELECT run, study, arm, seed, iteration,
                CAST(sum(steps) OVER (PARTITION BY run ORDER BY iteration) AS BIGINT) AS steps, cost,
                cost_standard_error, forward_speed_m_per_s, forward_speed_standard_error, stuck_share_by_distance,
                waypoints_per_episode, policy_kl
            FROM iterations LEFT JOIN runs USING (run)
            """,
        ),
    }
)
"""Each may read those before it."""


def asked(runs: pa.Schema = RUNS) -> dict[str, pa.Schema]:
    """All that a query may ask, by name, where the table of runs has these columns."""
    tables = {name: pa.schema([schema.RUN, *definition]) for name, definition in schema.TABLES.items()}
    views = {name: view.columns for name, view in VIEWS.items()}
    return {**tables, "runs": runs, **views, "columns": COLUMNS}


def read_by(sql: str) -> set[str]:
    """The tables that SQL may read: those that it names, and those of the views that it names."""
    text, everything = sql.lower(), {*schema.TABLES, "runs"}
    if any(word in text for word in DYNAMIC):
        return everything
    named = {name for name in (*everything, *VIEWS) if name in text}
    for name in reversed(list(VIEWS)):
        if name in named:
            named.update(VIEWS[name].sources)
    return named & everything


def described(tables: Mapping[str, pa.Schema]) -> pa.Table:
    """The columns of tables, as rows of COLUMNS."""
    rows = [row for name, definition in tables.items() for row in _described(name, definition)]
    return pa.Table.from_pylist(rows, COLUMNS)


def _described(table: str, definition: pa.Schema) -> Iterator[dict[str, str]]:
    for field in definition:
        length = fields.vector_length(field)
        metadata = {key.decode(): value.decode() for key, value in field.metadata.items()}
        yield {
            "table_name": table,
            "column_name": field.name,
            "type": str(field.type) if length is None else f"list<{field.type.value_type}>, {length}",
            "unit": metadata["unit"] or "text",
            "meaning": metadata["description"] + ("; may be null" if field.nullable else ""),
        }
